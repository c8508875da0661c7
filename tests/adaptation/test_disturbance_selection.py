"""A disturbance is fitted where windows need one: laws of leaving windows out, and what is found by it."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_disturbance import PUSH, RATIOS, body, flights, network
from test_least_squares import Push, pushes

import hybrid_jax as hj
from hybrid_jax.adaptation.disturbance_selection import left_out, select_disturbance
from hybrid_jax.adaptation.least_squares import fit_least_squares
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import disturbed, with_disturbance
from hybrid_jax.state import VELOCITY
from hybrid_jax.sweep.lanes import stack

HYBRID = hj.Hybrid(body(), network())
CHANGED = hj.Hybrid(body(**RATIOS), network())
NOISE = np.repeat(np.array([0.001, 0.0, 0.02, 0.02], np.float32), [3, 4, 3, 3])  # m, –, m/s, rad/s; as sensors have it


class Drag(AbstractVectorField):
    """What neither θ_p nor a constant can be, and no network of these tests knows."""

    def __call__(self, x, u):
        return jnp.zeros_like(x).at[VELOCITY].set(-0.1 * x[VELOCITY])


def measured(windows, seed):
    noise = NOISE * np.random.default_rng(seed).normal(size=windows.x.shape)
    return replace(windows, x=np.asarray(windows.x + noise, np.float32))


def test_left_out_of_a_linear_problem_is_a_fit_to_the_others():
    windows, design = pushes(12, 0.1)
    field = fit_least_squares(Push(jnp.ones(2)), windows).field
    found = left_out(field, windows)
    truth = np.asarray(windows.x, float).reshape(12, -1)
    for i in range(12):
        others = np.arange(12) != i
        gains = np.linalg.lstsq(design[others].reshape(-1, 2), truth[others].ravel(), rcond=None)[0]
        expected = np.sum((truth[i] - design[i] @ gains) ** 2) / windows.horizon
        assert found[i] == pytest.approx(expected, rel=1e-4)


def test_a_push_is_kept_with_all_that_was_fitted_beside_it():
    windows = flights(hj.Hybrid(disturbed(body(**RATIOS), PUSH), network()))
    found = select_disturbance(HYBRID, windows)
    assert found.needed
    np.testing.assert_allclose(found.fit.field.physics.residual.value, PUSH, atol=5e-3)
    np.testing.assert_allclose(found.fit.field.physics.physics.log_ratios["Ix"], RATIOS["Ix"], atol=2e-3)


def test_what_a_network_gets_wrong_is_not_taken_for_a_push():
    """Six numbers more fit these windows better, and the next ones worse: they are left at zero, and θ_p is alone."""
    windows = flights(hj.Hybrid(hj.Hybrid(body(**RATIOS), Drag()), network()))
    found, alone = select_disturbance(HYBRID, windows), fit_least_squares(HYBRID, windows)
    assert fit_least_squares(with_disturbance(HYBRID), windows).mse < 0.95 * alone.mse
    assert not found.needed
    np.testing.assert_array_equal(found.fit.field.physics.residual.value, 0.0)
    assert eqx.tree_equal(found.fit.field.physics.physics, alone.field.physics, rtol=1e-5, atol=1e-6)
    assert found.fit.mse == pytest.approx(float(alone.mse), rel=1e-4)


def test_noise_is_seldom_taken_for_a_push_and_hides_none_that_is_felt():
    quiet, pushed = flights(CHANGED), flights(disturbed_by(jnp.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0])))
    fit = jax.jit(jax.vmap(lambda windows: select_disturbance(HYBRID, windows).needed))
    alarms = fit(stack([measured(quiet, seed) for seed in range(20)]))
    # Six numbers that mean nothing gain more than a standard error in a few cases of a hundred.
    assert alarms.sum() <= 4
    assert fit(stack([measured(pushed, seed) for seed in range(20)])).all()


def disturbed_by(push):
    return hj.Hybrid(disturbed(body(**RATIOS), push), network())


def test_one_window_cannot_tell():
    windows = flights(disturbed_by(PUSH), count=1)
    assert not select_disturbance(HYBRID, windows).needed
