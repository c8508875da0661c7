"""Laws of the thrust that a network adds to each rotor: with the right function of R / h it is the ground effect."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from choices import mostly_slow
from evaluations import infer_batch, train_batch

from hybrid_jax import load, rotation, save
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.networks.mlp import InputScaling, ResidualNetwork, residual_network
from hybrid_jax.networks.normalisation import ChannelScaling
from hybrid_jax.networks.standardise import with_scaling
from hybrid_jax.networks.views import INPUTS, RotorThrust, _nearness, multirotor_network
from hybrid_jax.sim.forces import ground_effect, parameters_of
from hybrid_jax.state import BODY_RATES, QUATERNION, VELOCITY
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import IRIS

KEY = jax.random.key(0)
HOVER = InputScaling(IRIS.hover_speed, IRIS.hover_speed / 10)


class CheesemanBennett(AbstractVectorField):
    """T / T∞ − 1 of a rotor at R / h = x[0]."""

    def __call__(self, x, u):
        return 1 / (1 - (x / 4) ** 2) - 1


def shared():
    return RotorThrust(residual_network(1, 1, KEY, hidden=7, scaling=HOVER, norm="none"), IRIS)


def samples(count=6):
    """States at 0.1 … 1 m, tilted every way, and inputs, as columns."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(13, count))
    x[2] = np.linspace(0.1, 1.0, count)
    x[QUATERNION] = np.eye(4)[:, :1] + 0.1 * rng.normal(size=(4, count))
    x[QUATERNION] /= np.linalg.norm(x[QUATERNION], axis=0)
    return jnp.asarray(x), jnp.asarray(rng.uniform(500, 800, (4, count)))


@eqx.filter_jit
def deployed(field, x, u):
    return jax.vmap(field, in_axes=-1, out_axes=-1)(x, u)


def test_with_their_formula_it_is_the_simulator_s_ground_effect():
    x, u = samples()
    at_once = jax.vmap(ground_effect, (-1, -1, None, None), -1)
    force, torque = at_once(x, u, jnp.asarray(0.0), parameters_of(IRIS))
    turning = rotation.rotate(rotation.conjugate(x[QUATERNION]), torque) / np.array(IRIS.inertia)[:, None]
    found = deployed(RotorThrust(CheesemanBennett(), IRIS), x, u)
    assert np.abs(turning[:2]).max() > 1
    np.testing.assert_allclose(found[VELOCITY], force / IRIS.mass, atol=1e-5)
    np.testing.assert_allclose(found[BODY_RATES], turning, atol=1e-4)
    np.testing.assert_array_equal(found[: VELOCITY.start], 0)


@pytest.mark.parametrize("many", [train_batch, infer_batch])
def test_a_batch_is_its_samples(many):
    x, u = samples()
    np.testing.assert_allclose(many(shared(), x, u), deployed(shared(), x, u), rtol=1e-4, atol=1e-4)


def test_rotors_are_alike():
    """At one altitude an exchange of speeds is one of thrusts; equal ones push where the middle of the rotors is."""
    level, u = jnp.eye(13)[3].at[2].set(0.2), jnp.array([600.0, 650.0, 700.0, 750.0])
    one, other = shared()(level, u), shared()(level, u[::-1])
    np.testing.assert_allclose(one[VELOCITY], other[VELOCITY], rtol=1e-5)
    same = shared()(level, jnp.full(4, 600.0))
    x, y = np.mean(IRIS.rotor_positions, axis=0)
    turning = IRIS.mass * same[9] * np.array([y, -x]) / np.array(IRIS.inertia[:2])
    assert abs(same[9]) > 0.01
    np.testing.assert_allclose(same[BODY_RATES][:2], turning, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("inputs", "outputs"), mostly_slow((inputs, "rotors") for inputs in INPUTS))
def test_beside_any_network_it_begins_silent_learns_and_survives_a_file(inputs, outputs, tmp_path):
    known = {"inputs": inputs, "hidden": 5, "scaling": HOVER}
    (x, u), field = samples(), multirotor_network(IRIS, KEY, outputs=outputs, **known)
    alone = multirotor_network(IRIS, KEY, outputs="accelerations", **known)
    np.testing.assert_array_equal(deployed(field, x, u), deployed(alone, x, u))
    slope = eqx.filter_jit(eqx.filter_grad(lambda residual: jnp.sum(residual.train_batch(x, u))))(field)
    assert (slope.physics.field.weight_out != 0).any()
    moved = Hybrid(rigid_body(IRIS), jax.tree.map(lambda leaf: leaf + 0.1, field))
    save(tmp_path / "model.npz", moved)
    assert eqx.tree_equal(load(tmp_path / "model.npz").field, moved)


def test_what_all_rotors_read_is_scaled_by_windows():
    x, u = samples()
    windows = Trajectories(x.T, u.T[:, None], x.T[:, None], 0.01)
    field = with_scaling(multirotor_network(IRIS, KEY, outputs="rotors", hidden=5), windows)
    assert isinstance(field, Hybrid)
    assert isinstance(field.physics, RotorThrust)
    assert isinstance(field.physics.field, ResidualNetwork)
    scaling = field.physics.field.scaling
    assert isinstance(scaling, ChannelScaling)
    assert scaling.offset is not None
    np.testing.assert_allclose(scaling.offset, [_nearness(x, IRIS).mean(), u.mean()], rtol=1e-5)
