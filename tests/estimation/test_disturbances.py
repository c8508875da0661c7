"""A disturbance with a hidden state is predicted from its past, and white noise changes little."""

import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.dynamics.hidden import DisturbanceModel
from hybrid_jax.trajectories import split

DT, STEPS, BODY = 0.05, 10, hj.rigid_body(hj.IRIS)


class Spring(hj.AbstractVectorField):
    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - 4 * x[0]])


def swinging(x, u):
    """The mass with an oscillator that it drives and that no sensor shows."""
    slope, (_, speed, swing, turn) = Spring()(x[:2], u), x
    return jnp.stack([slope[0], slope[1] + 2 * swing, turn, 0.5 * speed - 9 * swing])


def flights(seed, swing=1.0, noise=0.0, count=4, t=200):
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


def test_a_hidden_swing_is_predicted_from_its_past():
    model = hj.fit_disturbance(Spring(), [flights(0)])
    assert error(model, flights(1)) < 0.3 * error(Spring(), flights(1))
    with pytest.warns(UserWarning, match=r"past: 0\.1 s are too short for filters of up to 3 s"):
        hj.observe(model, split(flights(1), 2)[0])


def test_white_noise_on_a_true_model_changes_little():
    noisy = flights(2, swing=0.0, noise=0.01)
    tested = flights(3, swing=0.0, noise=0.01)
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


def test_attitudes_are_corrected_in_their_tangent_space():
    """A constant torque that the model lacks, as an angular acceleration of 0.3 rad/s²."""
    windows = hovering(5, 0.2, 3, (0, 0, 0, 0.3, 0, 0), noise=0.0)
    model = hj.fit_disturbance(BODY, [windows])
    states = hj.observe(model, windows)
    reached = hj.rollout_batch(model, states[:, 180], windows.u[:, 180:], 0.01)[:, -1]
    plain = hj.rollout_batch(BODY, windows.x[:, 179], windows.u[:, 180:], 0.01)[:, -1]
    off, before = (np.abs(each[:, :13] - windows.x[:, -1])[:, 10:].max() for each in (reached, plain))
    assert off < 0.2 * before
    np.testing.assert_allclose(np.linalg.norm(reached[:, 3:7], axis=1), 1, atol=1e-4)


def test_a_model_is_refitted_near_the_one_before_and_saved(tmp_path):
    model = hj.fit_disturbance(Spring(), [flights(0)])
    again = hj.fit_disturbance(model, [flights(6, count=1, t=60)])
    assert again.time_constants == model.time_constants
    assert error(again, flights(1)) < 0.5 * error(Spring(), flights(1))
    hj.save(tmp_path / "m.npz", again)
    assert error(hj.load(tmp_path / "m.npz").field, flights(1)) == error(again, flights(1))


def test_a_hover_does_not_ruin_what_was_learned_in_motion():
    moving, before = hovering(5, 1, 6), hj.fit_disturbance(BODY, [hovering(1, 1, 6)])
    after = hj.fit_disturbance(before, [hovering(7, 0, 3)])

    def velocity_error(model):
        x0, u = hj.observe(model, moving)[:, 100], moving.u[:, 100:150]
        return np.sqrt(np.mean(np.square(hj.rollout_batch(model, x0, u, 0.01)[:, -1, 7:10] - moving.x[:, 149, 7:10])))

    assert velocity_error(before) < 0.5 * velocity_error(hj.fit_disturbance(BODY, [hovering(7, 0, 3)]))
    assert velocity_error(after) < 1.05 * velocity_error(before)


def test_what_does_not_fit_is_refused():
    refusal(lambda: hj.fit_disturbance(Spring(), []), "sequences")
    refusal(lambda: hj.fit_disturbance(Spring(), [flights(0, t=20)], steps=30), "sequences", 60)
