"""A hidden disturbance is predicted from its past; a constant one is told apart from θ_p, where windows need one."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import Push, pendulum, pushes, swings
from surface import refusal

import hybrid_jax as hj
from hybrid_jax import AbstractVectorField, fit_least_squares, rollout_batch, with_disturbance
from hybrid_jax.dynamics import ConstantDisturbance, DisturbanceModel
from hybrid_jax.estimation.normal_equations import left_out, normal_equations
from hybrid_jax.estimation.uncertainty import select_disturbance
from hybrid_jax.networks.views import multirotor_network
from hybrid_jax.trajectories import split
from hybrid_jax.vehicle import VELOCITY

DT, STEPS, BODY = 0.05, 10, hj.rigid_body(hj.IRIS)


class Spring(hj.AbstractVectorField):
    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - 4 * x[0]])


def swinging(x, u):
    """The mass with an oscillator that it drives and that no sensor shows."""
    slope, (_, speed, swing, turn) = Spring()(x[:2], u), x
    return jnp.stack([slope[0], slope[1] + 2 * swing, turn, 0.5 * speed - 9 * swing])


def driven(seed, swing=1.0, noise=0.0, count=4, t=200):
    random = np.random.default_rng(seed)
    x0 = random.normal(size=(count, 4)) * [1, 1, swing, swing]
    u = np.repeat(random.normal(size=(count, t // 10, 1)), 10, axis=1)
    field = swinging if swing else lambda x, u: jnp.concatenate([Spring()(x[:2], u), 0 * x[2:]])
    x = np.concatenate([x0[:, None], hj.rollout_batch(field, x0, u, DT)], axis=1)[..., :2]
    x = (x + noise * random.normal(size=x.shape)).astype("f4")
    return hj.Trajectories(x[:, 0], u.astype("f4"), x[:, 1:], DT)


def error(model, tested):
    """RMS of the states after STEPS intervals, from every tenth sample after the first 50."""
    starts, x = np.arange(50, tested.horizon - STEPS, 10), np.concatenate([tested.x0[:, None], tested.x], axis=1)
    states = hj.observe(model, tested) if isinstance(model, DisturbanceModel) else x
    u = np.stack([tested.u[:, i : i + STEPS] for i in starts], axis=1).reshape(-1, STEPS, 1)
    found = hj.rollout_batch(model, states[:, starts].reshape(-1, states.shape[-1]), u, DT)[:, -1, :2]
    return float(jnp.sqrt(jnp.mean(jnp.square(found - x[:, starts + STEPS].reshape(-1, 2)))))


def test_a_hidden_swing_is_predicted_from_its_past_and_white_noise_on_a_true_model_changes_little():
    model = hj.fit_disturbance(Spring(), [driven(0)])
    assert error(model, driven(1)) < 0.3 * error(Spring(), driven(1))
    with pytest.warns(UserWarning, match=r"past: 0\.1 s are too short for filters of up to 3 s"):
        hj.observe(model, split(driven(1), 2)[0])
    noisy = driven(2, swing=0.0, noise=0.01)
    tested = driven(3, swing=0.0, noise=0.01)
    assert error(hj.fit_disturbance(Spring(), [noisy]), tested) < 1.1 * error(Spring(), tested)


def hovering(seed, lively, count, push=(0.3, 0, 0, 0, 0, 0), noise=0.02):
    """Flights of 2 s with a push that the body lacks, as sensors with noise see them."""
    random = np.random.default_rng(seed)
    x0 = np.tile(np.eye(13, dtype="f4")[3], (count, 1))
    x0[:, 7:] = lively * random.normal(size=(count, 6))
    u = hj.IRIS.hover_speed * (1 + 0.01 * lively * random.normal(size=(count, 20, 4))).repeat(10, axis=1).astype("f4")
    x = np.array(hj.rollout_batch(hj.Hybrid(BODY, ConstantDisturbance(jnp.array(push))), x0, u, 0.01))
    x[..., 7:] += noise * random.normal(size=(count, 200, 6))
    return hj.Trajectories(x0, u, x.astype("f4"), 0.01)


def test_attitudes_are_corrected_in_their_tangent_space_and_a_hover_does_not_ruin_what_was_learned():
    """A constant torque that the model lacks, as an angular acceleration of 0.3 rad/s²."""
    windows = hovering(5, 0.2, 3, (0, 0, 0, 0.3, 0, 0), noise=0.0)
    model = hj.fit_disturbance(BODY, [windows])
    states = hj.observe(model, windows)
    reached = hj.rollout_batch(model, states[:, 180], windows.u[:, 180:], 0.01)[:, -1]
    plain = hj.rollout_batch(BODY, windows.x[:, 179], windows.u[:, 180:], 0.01)[:, -1]
    off, before = (np.abs(each[:, :13] - windows.x[:, -1])[:, 10:].max() for each in (reached, plain))
    assert off < 0.2 * before
    np.testing.assert_allclose(np.linalg.norm(reached[:, 3:7], axis=1), 1, atol=1e-4)
    moving, before = hovering(5, 1, 6), hj.fit_disturbance(BODY, [hovering(1, 1, 6)])
    after = hj.fit_disturbance(before, [hovering(7, 0, 3)])

    def velocity_error(model):
        x0, u = hj.observe(model, moving)[:, 100], moving.u[:, 100:150]
        return np.sqrt(np.mean(np.square(hj.rollout_batch(model, x0, u, 0.01)[:, -1, 7:10] - moving.x[:, 149, 7:10])))

    assert velocity_error(before) < 0.5 * velocity_error(hj.fit_disturbance(BODY, [hovering(7, 0, 3)]))
    assert velocity_error(after) < 1.05 * velocity_error(before)


def test_a_model_is_refitted_near_the_one_before_and_saved_and_what_does_not_fit_is_refused(tmp_path):
    model = hj.fit_disturbance(Spring(), [driven(0)])
    again = hj.fit_disturbance(model, [driven(6, count=1, t=60)])
    assert again.time_constants == model.time_constants
    assert error(again, driven(1)) < 0.5 * error(Spring(), driven(1))
    hj.save(tmp_path / "m.npz", again)
    assert error(hj.load(tmp_path / "m.npz").field, driven(1)) == error(again, driven(1))
    refusal(lambda: hj.fit_disturbance(Spring(), []), "sequences")
    refusal(lambda: hj.fit_disturbance(Spring(), [driven(0, t=20)], steps=30), "sequences", 60)


PUSH = jnp.array([0.3, 2.7, -0.5, 0.2, -0.1, 0.05])
RATIOS = {"Ix": 0.6, "Iy": -0.3, "k": 0.05}
NOISE = np.repeat(np.array([0.001, 0.0, 0.02, 0.02], np.float32), [3, 4, 3, 3])  # m, –, m/s, rad/s; as sensors have it


@cache
def network():
    options = {"inputs": "no_xy_yaw", "outputs": "accelerations", "hidden": 8, "norm": "none"}
    return jax.tree.map(lambda leaf: 0.1 * leaf, multirotor_network(hj.IRIS, jax.random.key(0), **options))


def body(**ratios):
    return hj.RigidBody({name: jnp.asarray(ratios.get(name, 0.0)) for name in RATIOS}, hj.IRIS)


def flights(field, count=20, steps=10):
    keys = jax.random.split(jax.random.key(1), 2)
    x0 = 0.5 * jax.random.normal(keys[0], (count, 13))
    x0 = x0.at[:, 3].add(2.0)
    x0 = x0.at[:, 3:7].divide(jnp.linalg.norm(x0[:, 3:7], axis=1, keepdims=True))
    u = hj.IRIS.hover_speed * jax.random.uniform(keys[1], (count, steps, 4), minval=0.8, maxval=1.2)
    return hj.Trajectories(x0, u, rollout_batch(field, x0, u, 0.01), dt=0.01)


@cache
def hybrid(**ratios):
    return hj.Hybrid(body(**ratios), network())


def disturbed_by(push):
    return hj.Hybrid(hj.Hybrid(body(**RATIOS), ConstantDisturbance(push)), network())


def test_parameters_and_push_are_found_together_and_the_network_stays():
    found = fit_least_squares(with_disturbance(hybrid()), flights(disturbed_by(PUSH)))
    assert found.converged
    for name, ratio in RATIOS.items():
        np.testing.assert_allclose(found.field.physics.physics.deviations[name], ratio, atol=2e-3)
    np.testing.assert_allclose(found.field.physics.residual.value, PUSH, atol=5e-3)
    assert eqx.tree_equal(found.field.residual, network())


class Drag(AbstractVectorField):
    """What neither θ_p nor a constant can be, and no network of these tests knows."""

    def __call__(self, x, u):
        return jnp.zeros_like(x).at[VELOCITY].set(-0.1 * x[VELOCITY])


def test_left_out_of_a_linear_problem_is_a_fit_to_the_others():
    windows, design = pushes(12, 0.1)
    field = fit_least_squares(Push(jnp.ones(2)), windows).field
    found = left_out(normal_equations(field, windows, None, 5, None), windows.horizon)
    truth = np.asarray(windows.x, float).reshape(12, -1)
    for i in range(12):
        others = np.arange(12) != i
        gains = np.linalg.lstsq(design[others].reshape(-1, 2), truth[others].ravel(), rcond=None)[0]
        expected = np.sum((truth[i] - design[i] @ gains) ** 2) / windows.horizon
        assert found[i] == pytest.approx(expected, rel=1e-4)


def test_what_a_network_gets_wrong_is_not_taken_for_a_push_and_one_window_cannot_tell():
    """Six numbers more fit these windows better, and the next ones worse: they are left at zero, and θ_p is alone."""
    windows = flights(hj.Hybrid(hj.Hybrid(body(**RATIOS), Drag()), network()))
    found, alone = select_disturbance(hybrid(), windows), fit_least_squares(hybrid(), windows)
    assert fit_least_squares(with_disturbance(hybrid()), windows).mse < 0.95 * alone.mse
    assert not found.needed
    np.testing.assert_array_equal(found.fit.field.physics.residual.value, 0.0)
    assert eqx.tree_equal(found.fit.field.physics.physics, alone.field.physics, rtol=1e-5, atol=1e-6)
    assert found.fit.mse == pytest.approx(float(alone.mse), rel=1e-4)
    windows, push = swings(1), jnp.array([0.0, 1.5])
    pushed = rollout_batch(hj.Hybrid(pendulum(), ConstantDisturbance(push)), windows.x0, windows.u, windows.dt)
    assert not select_disturbance(pendulum(0.7), replace(windows, x=pushed)).needed


@pytest.mark.slow
def test_noise_is_seldom_taken_for_a_push_and_hides_none_that_is_felt():
    quiet, pushed = flights(hybrid(**RATIOS)), flights(disturbed_by(jnp.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0])))
    noise = NOISE * np.random.default_rng(0).normal(size=(20, *quiet.x.shape)).astype(np.float32)
    needed = lambda windows, noise: select_disturbance(hybrid(), replace(windows, x=windows.x + noise)).needed  # noqa: E731
    fit = jax.jit(jax.vmap(needed, in_axes=(None, 0)))
    # Six numbers that mean nothing gain more than a standard error in a few cases of a hundred.
    assert fit(quiet, noise).sum() <= 4
    assert fit(pushed, noise).all()
