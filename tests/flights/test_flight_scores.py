"""Scores of recorded flight are what their definitions say, and baselines fly as they should."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluations import infer_batch, train_batch

from hybrid_jax import Trajectories, rigid_body, rotation
from hybrid_jax.dynamics.baselines import FrozenRates, HoldState
from hybrid_jax.flights.scores import errors_between, flight_errors
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from hybrid_jax.vehicle import IRIS


def states(count, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, 13)).astype(np.float32)
    x[:, QUATERNION] /= np.linalg.norm(x[:, QUATERNION], axis=1, keepdims=True)
    return x


def flights(count=7, steps=4):
    u = np.random.default_rng(1).uniform(600, 700, (count, steps, 4)).astype(np.float32)
    x0 = states(count)
    return Trajectories(x0, u, np.asarray(jax.jit(rollout_batch)(rigid_body(IRIS), x0, u, 0.01)), 0.01)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.3, 3.0])
def test_errors_are_lengths_and_an_angle(angle):
    x = states(5)
    turn = rotation.from_axis_angle(jnp.array([0.6, 0.0, 0.8]), jnp.asarray(angle))
    q = jax.vmap(lambda q: -rotation.multiply(q, turn))(x[:, QUATERNION])  # −q is the same rotation
    other = jnp.asarray(x).at[:, QUATERNION].set(q)
    for part, offset in ((POSITION, [3, 4, 0]), (VELOCITY, [0, 0, -2]), (BODY_RATES, [1, 2, 2])):
        other = other.at[:, part].add(jnp.array(offset, float))
    expected = (5, 2, angle, 3)
    for found, value in zip(errors_between(other, jnp.asarray(x)), expected, strict=True):
        np.testing.assert_allclose(found, value, rtol=1e-3, atol=1e-6)  # float32; an arc cosine would err by 3e-4


def test_exact_physics_has_no_error_and_chunks_do_not_matter(monkeypatch):
    windows = flights()
    for error in flight_errors(rigid_body(IRIS), windows):
        assert error.shape == (7, 4)
        assert (error < 1e-5).all()
    whole = flight_errors(HoldState(), windows)
    monkeypatch.setattr("hybrid_jax.flights.scores.CHUNK", 3)
    np.testing.assert_allclose(np.stack(whole), np.stack(flight_errors(HoldState(), windows)), rtol=1e-6)


def test_windows_of_other_states_are_refused():
    with pytest.raises(ValueError, match="states of 13"):
        flight_errors(HoldState(), Trajectories(np.zeros((2, 2)), np.zeros((2, 3, 1)), np.zeros((2, 3, 2)), 0.1))


def test_baselines_hold_the_state_or_freeze_rates():
    x, u = jnp.asarray(states(5).T), jnp.full((4, 5), 650.0)
    plain = rigid_body(IRIS)
    for evaluate in map(eqx.filter_jit, (train_batch, infer_batch, lambda field, x, u: jax.vmap(field, -1, -1)(x, u))):
        assert (evaluate(HoldState(), x, u) == 0).all()
        frozen, whole = evaluate(FrozenRates(plain), x, u), evaluate(plain, x, u)
        assert (frozen[BODY_RATES] == 0).all()
        np.testing.assert_allclose(frozen[:10], whole[:10], rtol=1e-6, atol=1e-6)
    windows = flights()
    np.testing.assert_array_equal(rollout_batch(HoldState(), windows.x0, windows.u, 0.01)[:, -1], windows.x0)
