"""Laws of the multirotor's field, in double precision: what each term does, and that what is absent changes nothing."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluations import infer_batch, train_batch
from jax.flatten_util import ravel_pytree
from matrices import newton_euler

from hybrid_jax import Hybrid, load, rotation, save
from hybrid_jax.dynamics.base import state_space, trainable
from hybrid_jax.dynamics.baselines import FrozenRates, HoldState
from hybrid_jax.dynamics.composition import Frozen
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE, RigidBody, rigid_body
from hybrid_jax.dynamics.terms import SHAPES, SIGNED, Terms
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.state import POSITION, QUATERNION, VELOCITY
from hybrid_jax.vehicle import IRIS

pytestmark = pytest.mark.usefixtures("double_precision")  # laws hold to round-off

ALL = tuple(name for name in SHAPES if name not in ("mass", "k"))
KNOWN = Terms(
    torque_gain=(0.9, 1.1, 0.8),
    centre_of_mass=(0.01, -0.02),
    drag=(0.3, 0.4, 0.1),
    cable_pull=(4.0, 3.0),
    aerodynamic_moment=((0.0, -0.02, 0.0), (0.03, 0.0, 0.01), (0.0, 0.005, 0.0)),
    rate_damping=(0.02, 0.03, 0.01),
    velocity_gain=(0.95, 0.9, 1.02),
    velocity_lag=0.2,
)


def samples(count=6, seed=1):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(13, count)) * 2
    x[QUATERNION] /= np.linalg.norm(x[QUATERNION], axis=0)
    return jnp.asarray(x), jnp.asarray(rng.uniform(400, 900, (4, count)))


def moved(field, size=0.1, seed=2):
    """The field with every parameter away from nominal."""
    rng = np.random.default_rng(seed)
    leaves, structure = jax.tree.flatten(field)
    return jax.tree.unflatten(structure, [leaf + size * rng.normal(size=leaf.shape) for leaf in leaves])


@eqx.filter_jit
def one_by_one(field, x, u):
    return jax.vmap(field, -1, -1)(x, u)


@pytest.mark.parametrize("learn", [("Ix", "Iy", "k"), ALL, ()], ids=["paper", "all", "nothing"])
def test_at_nominal_it_is_the_rigid_body(learn):
    x, u = samples()
    np.testing.assert_allclose(
        one_by_one(rigid_body(IRIS, learn), x, u), one_by_one(rigid_body(IRIS), x, u), rtol=1e-14, atol=1e-13
    )


def test_it_is_newton_euler_with_drag_moment_damping_gain_and_offset():
    k = (8e-6, 9e-6, 8.5e-6, 7e-6)
    vehicle = replace(IRIS, thrust_coefficient=8e-6)
    field = rigid_body(vehicle, ("k_rotors",), KNOWN)
    field = eqx.tree_at(lambda field: field.deviations["k_rotors"], field, jnp.log(jnp.array(k) / 8e-6))
    x, u = samples()
    expected = np.stack(
        [newton_euler(*map(np.asarray, pair), vehicle, KNOWN, k) for pair in zip(x.T, u.T, strict=True)]
    )
    np.testing.assert_allclose(one_by_one(field, x, u).T, expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("name", SIGNED)
def test_a_known_term_is_a_learned_one_at_its_value(name):
    x, u = samples()
    value = getattr(KNOWN, name)
    terms = Terms(**{"drag": KNOWN.drag, name: value})  # a lag without a force is none
    known, learned = rigid_body(IRIS, (), terms), rigid_body(IRIS, (name,), terms)
    np.testing.assert_allclose(learned.theta()[name], value, rtol=1e-15)
    np.testing.assert_allclose(one_by_one(learned, x, u), one_by_one(known, x, u), rtol=1e-13, atol=1e-12)
    assert (one_by_one(moved(learned), x, u) != one_by_one(known, x, u)).any()


MINIBATCHES = {"rigid body": rigid_body(IRIS)} | {
    " ".join(learn) or "nothing": rigid_body(IRIS, learn, KNOWN) for learn in [("Ix", "Iy", "k"), ALL, ("drag",), ()]
}


@pytest.mark.parametrize("field", MINIBATCHES.values(), ids=MINIBATCHES)
def test_a_minibatch_and_its_gradient_are_those_of_its_samples(field):
    field, (x, u) = moved(field), samples()
    weights = jnp.asarray(np.random.default_rng(2).normal(size=(13, 6)))

    def slope(evaluate):
        return jax.jit(jax.grad(lambda field, x, u: jnp.sum(weights * evaluate(field, x, u)), (0, 1, 2)))(field, x, u)

    for evaluate in map(eqx.filter_jit, (train_batch, infer_batch)):
        np.testing.assert_allclose(evaluate(field, x, u), one_by_one(field, x, u), rtol=1e-12, atol=1e-11)
    for ours, theirs in zip(jax.tree.leaves(slope(train_batch)), jax.tree.leaves(slope(one_by_one)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-11)


def test_all_terms_are_recovered_from_flights_made_with_them():
    learn = tuple(name for name in ALL if name not in ("torque_gain", "velocity_gain"))
    truth, (x, u) = moved(rigid_body(IRIS, learn), 0.05), samples(30)
    start, rebuild = ravel_pytree(rigid_body(IRIS, learn))

    @jax.jit
    def flown(parameters):
        return rollout_batch(rebuild(parameters), x.T, u.T[:, None], 0.02).ravel()

    found, data = start, flown(ravel_pytree(truth)[0])
    slopes = jax.jit(jax.jacfwd(flown))
    for _ in range(6):  # Gauss and Newton's steps
        found = found + np.linalg.lstsq(slopes(found), data - flown(found))[0]
    for name, value in truth.theta().items():
        np.testing.assert_allclose(rebuild(found).theta()[name], value, rtol=1e-6, err_msg=name)


AROUND = {"itself": lambda body: body, "frozen rates": FrozenRates, "frozen": Frozen}
AROUND |= {"hybrid": lambda body: Hybrid(body, HoldState())}


@pytest.mark.parametrize("around", AROUND.values(), ids=AROUND)
def test_position_moves_with_the_true_velocity_where_the_log_s_lags(around):
    """An estimator that knows thrust alone has v̂˙ = R T e_z / m − g e_z + (v − v̂) / λ, the last across the thrust."""
    lag, (x, u) = 0.25, samples()
    field = around(rigid_body(IRIS, (), Terms(drag=(0.3, 0.4, 0.0), velocity_lag=lag)))
    thrust = one_by_one(rigid_body(IRIS, ()), x, u)[VELOCITY]
    behind = jnp.asarray([0.3, -0.2, 0.0])  # v − v̂ in the body
    alone = lambda field, x, u: field(x[:, 0], u[:, 0])[:, None]  # noqa: E731
    evaluations = [*map(eqx.filter_jit, (train_batch, infer_batch, alone))]
    for state, inputs, known in zip(x.T, u.T, thrust.T, strict=True):
        velocity = state[VELOCITY] + rotation.rotate(state[QUATERNION], behind)
        estimator = known + (velocity - state[VELOCITY]) / lag
        push = jnp.concatenate([estimator - field(state, inputs)[VELOCITY], jnp.zeros(3)])
        for evaluate in evaluations:
            found = evaluate(Hybrid(field, ConstantDisturbance(push)), state[:, None], inputs[:, None])[:, 0]
            np.testing.assert_allclose(found[POSITION], velocity, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(found[VELOCITY], estimator, rtol=1e-12, atol=1e-12)


def test_a_body_that_does_not_turn_tells_where_its_cable_pulls():
    """A force at (0, 0, −h) that the rotors hold makes the moment −h e_z × F, so F follows from their torque."""
    below, pull = 0.05, np.array([0.02, -0.03, 0.0])
    arms = np.array(IRIS.rotor_positions)
    held = [*-np.cross([0.0, 0.0, -below], pull)[:2], IRIS.mass * IRIS.gravity]
    lifts = np.linalg.lstsq(np.stack([arms[:, 1], -arms[:, 0], np.ones(4)]), np.array(held))[0]
    field = rigid_body(IRIS, (), Terms(cable_pull=(1 / below, 1 / below)))
    level = jnp.zeros(13).at[3].set(1.0)
    derivative = field(level, jnp.sqrt(lifts / IRIS.thrust_coefficient))
    np.testing.assert_allclose(IRIS.mass * derivative[VELOCITY], pull, atol=1e-12)


def test_a_learned_mass_is_that_of_a_heavier_vehicle():
    heavier = replace(IRIS, mass=1.3 * IRIS.mass)
    learned = RigidBody({"mass": jnp.log(1.3)}, IRIS, KNOWN)
    np.testing.assert_allclose(learned.theta()["mass"], heavier.mass)
    x, u = samples()
    expected = one_by_one(rigid_body(heavier, (), KNOWN), x, u)
    np.testing.assert_allclose(one_by_one(learned, x, u), expected, rtol=1e-13, atol=1e-13)


def test_it_survives_a_file_and_its_states_are_checked(tmp_path):
    field = Hybrid(moved(rigid_body(IRIS, ALL, KNOWN)), rigid_body(IRIS))
    save(tmp_path / "model.npz", field)
    assert eqx.tree_equal(load(tmp_path / "model.npz").field, field)
    assert sum(jax.tree.leaves(trainable(field.physics))) == len(ALL)
    assert state_space(field) is RIGID_BODY_SPACE


def test_single_precision_stays_single():
    x, u = (part[:, 0].astype(np.float32) for part in samples())
    field = jax.tree.map(lambda leaf: leaf.astype(np.float32), rigid_body(IRIS, ALL, KNOWN))
    assert field(x, u).dtype == np.float32
