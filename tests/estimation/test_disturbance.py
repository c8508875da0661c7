"""A constant disturbance is told apart from θ_p, the network stays, and it is fitted where windows need one."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import Push, pendulum, pushes, swings

import hybrid_jax as hj
from hybrid_jax import AbstractVectorField, fit_least_squares, rollout_batch
from hybrid_jax.dynamics.disturbance import ConstantDisturbance, with_disturbance
from hybrid_jax.estimation.normal_equations import left_out, normal_equations
from hybrid_jax.estimation.uncertainty import select_disturbance
from hybrid_jax.networks.views import multirotor_network
from hybrid_jax.vehicle import VELOCITY

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


def test_what_a_network_gets_wrong_is_not_taken_for_a_push():
    """Six numbers more fit these windows better, and the next ones worse: they are left at zero, and θ_p is alone."""
    windows = flights(hj.Hybrid(hj.Hybrid(body(**RATIOS), Drag()), network()))
    found, alone = select_disturbance(hybrid(), windows), fit_least_squares(hybrid(), windows)
    assert fit_least_squares(with_disturbance(hybrid()), windows).mse < 0.95 * alone.mse
    assert not found.needed
    np.testing.assert_array_equal(found.fit.field.physics.residual.value, 0.0)
    assert eqx.tree_equal(found.fit.field.physics.physics, alone.field.physics, rtol=1e-5, atol=1e-6)
    assert found.fit.mse == pytest.approx(float(alone.mse), rel=1e-4)


@pytest.mark.slow
def test_noise_is_seldom_taken_for_a_push_and_hides_none_that_is_felt():
    quiet, pushed = flights(hybrid(**RATIOS)), flights(disturbed_by(jnp.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0])))
    noise = NOISE * np.random.default_rng(0).normal(size=(20, *quiet.x.shape)).astype(np.float32)
    needed = lambda windows, noise: select_disturbance(hybrid(), replace(windows, x=windows.x + noise)).needed  # noqa: E731
    fit = jax.jit(jax.vmap(needed, in_axes=(None, 0)))
    # Six numbers that mean nothing gain more than a standard error in a few cases of a hundred.
    assert fit(quiet, noise).sum() <= 4
    assert fit(pushed, noise).all()


def test_one_window_cannot_tell():
    windows, push = swings(1), jnp.array([0.0, 1.5])
    pushed = rollout_batch(hj.Hybrid(pendulum(), ConstantDisturbance(push)), windows.x0, windows.u, windows.dt)
    assert not select_disturbance(pendulum(0.7), replace(windows, x=pushed)).needed
