"""Laws of the rigid body f_p, in double precision."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluations import infer_batch, train_batch
from matrices import newton_euler
from systems import ODD

from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.baselines import HoldState
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.rigid_body import LEARNED, RigidBody, perturbed, rigid_body
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.integrate import rollout
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from hybrid_jax.vehicle import IRIS

pytestmark = pytest.mark.usefixtures("double_precision")  # laws hold to round-off


def level(**parts):
    x = jnp.zeros(13).at[3].set(1.0)
    for where, value in parts.items():
        x = x.at[{"v": VELOCITY, "w": BODY_RATES}[where]].set(jnp.asarray(value))
    return x


def samples(count, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, 13)) * 3
    x[:, QUATERNION] /= np.linalg.norm(x[:, QUATERNION], axis=1, keepdims=True)
    return x, rng.uniform(0, 1100, (count, 4))


@pytest.mark.parametrize("vehicle", [IRIS, ODD], ids=["iris", "odd"])
def test_it_is_newton_euler(vehicle):
    logs = dict(zip(LEARNED, jnp.array([0.3, -0.4, 0.1]), strict=True))
    ix, iy, iz = vehicle.inertia
    true = replace(vehicle, inertia=(float(ix * np.exp(0.3)), float(iy * np.exp(-0.4)), iz))
    k = vehicle.thrust_coefficient * np.exp(0.1)
    for x, u in zip(*samples(8), strict=True):
        # Round-off of float64 at accelerations of some 1000 rad/s².
        expected = newton_euler(x, u, true, Terms(), [k] * 4)
        np.testing.assert_allclose(RigidBody(logs, vehicle)(x, u), expected, rtol=1e-12, atol=1e-11)


def test_hover_is_an_equilibrium():
    # The Iris' rotors are not quite symmetric: with four equal rotors only the forces cancel.
    symmetric = replace(IRIS, rotor_positions=((0.1, -0.2), (-0.1, 0.2), (0.1, 0.2), (-0.1, -0.2)))
    change = rigid_body(symmetric)(level(), jnp.full(4, symmetric.hover_speed))
    np.testing.assert_allclose(change, 0, atol=1e-14)  # round-off of g − g
    np.testing.assert_allclose(rigid_body(IRIS)(level(), jnp.full(4, IRIS.hover_speed))[VELOCITY], 0, atol=1e-14)


def test_free_fall_is_exact():
    start = level(v=[1.0, -2.0, 3.0])
    seconds = 0.1 * np.arange(1, 6)[:, None]
    path = rollout(rigid_body(IRIS), start, jnp.zeros((5, 4)), 0.1)
    v0, g = np.array([1.0, -2.0, 3.0]), np.array([0, 0, -IRIS.gravity])
    # A parabola is within the order of RK4: round-off alone remains.
    np.testing.assert_allclose(path[:, VELOCITY], v0 + g * seconds, rtol=0, atol=1e-13)
    np.testing.assert_allclose(path[:, POSITION], v0 * seconds + g * seconds**2 / 2, rtol=0, atol=1e-13)


def test_torque_free_spin_keeps_energy_and_angular_momentum():
    path = rollout(rigid_body(ODD), level(w=[1.0, 4.0, 0.5]), jnp.zeros((200, 4)), 0.005)
    momentum = np.array(ODD.inertia) * np.asarray(path[:, BODY_RATES])
    energy = (momentum * path[:, BODY_RATES]).sum(1) / 2
    assert np.ptp(path[:, 10]) > 1  # it tumbles: Iy lies outside, so all three rates move
    # RK4's error over 1 s: (|ω| h)⁴ = 2e-7 at most.
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(momentum, axis=1), np.linalg.norm(momentum[0]), rtol=1e-7)


@pytest.mark.parametrize(
    ("stronger", "axis", "sign"),
    [((1, 2), 10, 1), ((0, 3), 10, -1), ((0, 2), 11, -1), ((1, 3), 11, 1), ((2, 3), 12, 1), ((0, 1), 12, -1)],
    ids=["left: roll +", "right: roll −", "front: pitch −", "rear: pitch +", "spin +", "spin −"],
)
def test_signs_of_torque(stronger, axis, sign):
    """Body x forward, y left, z up: the left rotors lift the left side, the front ones the nose (which is −y)."""
    u = jnp.full(4, 600.0).at[jnp.array(stronger)].set(700.0)
    assert sign * rigid_body(IRIS)(level(), u)[axis] > 1


def test_theta_is_nominal_at_zero_and_positive_everywhere():
    found = rigid_body(IRIS).theta()
    assert {name: float(value) for name, value in found.items()} == {"Ix": 0.02912, "Iy": 0.02912, "k": 8.54858e-6}
    for log in (-50.0, -1.0, 3.0):
        extreme = RigidBody({name: jnp.asarray(log) for name in LEARNED}, IRIS).theta()
        assert all(value > 0 for value in extreme.values())


def test_a_guess_lies_in_its_box_and_follows_its_key():
    guesses = jax.vmap(lambda key: perturbed(IRIS, key, low=0.5, high=2.0))(jax.random.split(jax.random.key(0), 500))
    for name in LEARNED:
        factors = np.exp(guesses.deviations[name])
        assert 0.5 <= factors.min() < 0.51  # 500 draws leave a gap of about ln 4 / 500 at the ends
        assert 1.96 < factors.max() <= 2.0
    again = perturbed(IRIS, jax.random.split(jax.random.key(0), 500)[3], low=0.5, high=2.0)
    assert all(again.deviations[name] == guesses.deviations[name][3] for name in LEARNED)


def test_a_torque_beside_a_forced_body_turns_it_by_its_own_inertia():
    """A body that is told the nominal vehicle's ω̇ under a torque τ turns by τ / I, whatever its I."""
    force, torque = jnp.array([1.0, -2.0, 3.0]), jnp.array([0.1, -0.2, 0.3])

    class Push(AbstractVectorField):
        def __call__(self, x, u):
            nominal = jnp.concatenate([jnp.zeros(7), force / ODD.mass, torque / jnp.array(ODD.inertia)])
            return jnp.broadcast_to(nominal.reshape(-1, *(1,) * (x.ndim - 1)), x.shape)

    logs = dict(zip(LEARNED, jnp.array([0.3, -0.4, 0.1]), strict=True))
    inertia = np.array(ODD.inertia) * np.exp([0.3, -0.4, 0.0])
    added = np.concatenate([np.zeros(7), force / ODD.mass, torque / inertia])
    body = RigidBody(logs, ODD, wrench=True)
    for field in (Hybrid(body, Push()), Hybrid(Hybrid(body, HoldState()), Push())):
        for x, u in zip(*samples(3), strict=True):
            np.testing.assert_allclose(field(x, u), RigidBody(logs, ODD)(x, u) + added, rtol=1e-12, atol=1e-11)
        x, u = (jnp.asarray(part).T for part in samples(3))
        expected = jax.vmap(field, -1, -1)(x, u)
        for evaluate in (train_batch, infer_batch):
            np.testing.assert_allclose(evaluate(field, x, u), expected, rtol=1e-12, atol=1e-11)
