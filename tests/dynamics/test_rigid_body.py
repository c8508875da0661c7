"""Laws of the rigid body f_p and of each of its terms, in double precision."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import ODD, columns, infer_batch, one_by_one, train_batch

from hybrid_jax import IRIS, AbstractVectorField, Frozen, Hybrid, rotation
from hybrid_jax.dynamics import ConstantDisturbance, HoldState
from hybrid_jax.dynamics.rigid_body import LEARNED, FrozenRates, RigidBody, perturbed, rigid_body
from hybrid_jax.dynamics.terms import SHAPES, SIGNED, Terms, units_of
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, VELOCITY

pytestmark = pytest.mark.usefixtures("double_precision")  # laws hold to round-off

ALL = tuple(name for name in SHAPES if name not in ("mass", "k"))
KNOWN = Terms(
    torque_gain=(0.9, 1.1, 0.8), centre_of_mass=(0.01, -0.02), drag=(0.3, 0.4, 0.1), cable_pull=(4.0, 3.0),
    aerodynamic_moment=((0.0, -0.02, 0.0), (0.03, 0.0, 0.01), (0.0, 0.005, 0.0)), rate_damping=(0.02, 0.03, 0.01),
    velocity_gain=(0.95, 0.9, 1.02), velocity_lag=0.2, translational_lift=0.03, rotor_drag=(2e-4, 3e-4, 1e-4),
)  # fmt: skip


def moved(field, size=0.1, seed=2):
    rng = np.random.default_rng(seed)
    leaves, structure = jax.tree.flatten(field)
    return jax.tree.unflatten(structure, [leaf + size * rng.normal(size=leaf.shape) for leaf in leaves])


def newton_euler(x, u, vehicle, terms, k):
    """The equations of motion a second time: matrices, a full inertia tensor and each rotor's force at its place."""
    w, *vector = x[QUATERNION]
    a, b, c = vector
    skew = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    attitude = np.eye(3) + 2 * w * skew + 2 * skew @ skew
    velocity, rates = attitude.T @ x[VELOCITY], x[BODY_RATES]
    force, torque, of_drag = -np.diag(terms.drag) @ velocity, np.zeros(3), np.zeros(3)
    for place, sign, speed, one in zip(vehicle.rotor_positions, vehicle.spin, u, k, strict=True):
        hub = np.array([*(np.array(place) - terms.centre_of_mass), 0.0])
        own = np.array([0, 0, one * speed**2])
        air, lift = velocity + np.cross(rates, hub), terms.translational_lift / len(u)
        drag = [0, 0, lift * (air[:2] @ air[:2])] - speed * np.array(terms.rotor_drag) * air
        force, torque, of_drag = force + own + drag, torque + np.cross(hub, own), of_drag + np.cross(hub, drag)
        torque[2] += sign * vehicle.torque_coefficient * speed**2
    inertia = np.diag(vehicle.inertia)
    torque = np.array(terms.torque_gain) * torque
    force += np.array((*terms.cable_pull, 0.0)) * [torque[1], -torque[0], 0.0]
    torque += of_drag + np.array(terms.aerodynamic_moment) @ velocity - np.array(terms.rate_damping) * rates
    acceleration = attitude @ force / vehicle.mass - [0, 0, vehicle.gravity]
    unseen = terms.velocity_lag * np.array([1, 1, 0]) * force / vehicle.mass
    moved = attitude @ (terms.velocity_gain * velocity + unseen)
    p, q, r = rates
    turning = 0.5 * np.array([[0, -p, -q, -r], [p, 0, r, -q], [q, -r, 0, p], [r, q, -p, 0]]) @ x[QUATERNION]
    spin_up = np.linalg.solve(inertia, torque - np.cross(rates, inertia @ rates))
    return np.concatenate([moved, turning, acceleration, spin_up])


@pytest.mark.parametrize("vehicle", [IRIS, ODD], ids=["iris", "odd"])
@pytest.mark.parametrize("terms", [Terms(), KNOWN], ids=["body", "terms"])
def test_it_is_newton_euler_at_any_parameters(terms, vehicle):
    field = rigid_body(vehicle, ("Ix", "Iy", "k_rotors"), terms)
    logs = {"Ix": jnp.array(0.3), "Iy": jnp.array(-0.4), "k_rotors": jnp.array([0.1, -0.1, 0.2, 0.0])}
    field = eqx.tree_at(lambda field: field.deviations, field, logs)
    inertia = tuple((np.array(vehicle.inertia) * np.exp([0.3, -0.4, 0.0])).tolist())
    true, k = replace(vehicle, inertia=inertia), vehicle.thrust_coefficient * np.exp(logs["k_rotors"])
    x, u = columns()
    expected = [newton_euler(*map(np.asarray, pair), true, terms, k) for pair in zip(x.T, u.T, strict=True)]
    np.testing.assert_allclose(one_by_one(field, x, u).T, expected, rtol=1e-11, atol=1e-11)


def test_theta_is_nominal_at_zero_and_positive_everywhere_and_a_guess_lies_in_its_box():
    found = rigid_body(IRIS).theta()
    assert {name: float(value) for name, value in found.items()} == {"Ix": 0.02912, "Iy": 0.02912, "k": 8.54858e-6}
    for log in (-50.0, -1.0, 3.0):
        extreme = RigidBody({name: jnp.asarray(log) for name in LEARNED}, IRIS).theta()
        assert all(value > 0 for value in extreme.values())
    guesses = jax.vmap(lambda key: perturbed(IRIS, key, low=0.5, high=2.0))(jax.random.split(jax.random.key(0), 500))
    for name in LEARNED:
        factors = np.exp(guesses.deviations[name])
        assert 0.5 <= factors.min() < 0.51  # 500 draws leave a gap of about ln 4 / 500 at the ends
        assert 1.96 < factors.max() <= 2.0
    again = perturbed(IRIS, jax.random.split(jax.random.key(0), 500)[3], low=0.5, high=2.0)
    assert all(again.deviations[name] == guesses.deviations[name][3] for name in LEARNED)


@pytest.mark.parametrize("name", SIGNED)
def test_a_known_term_is_a_learned_one_at_its_value(name):
    x, u = columns()
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
    field, (x, u) = moved(field), columns()
    weights = jnp.asarray(np.random.default_rng(2).normal(size=(13, 6)))

    def slope(evaluate):
        return jax.jit(jax.grad(lambda field, x, u: jnp.sum(weights * evaluate(field, x, u)), (0, 1, 2)))(field, x, u)

    for evaluate in map(eqx.filter_jit, (train_batch, infer_batch)):
        np.testing.assert_allclose(evaluate(field, x, u), one_by_one(field, x, u), rtol=1e-12, atol=1e-11)
    for ours, theirs in zip(jax.tree.leaves(slope(train_batch)), jax.tree.leaves(slope(one_by_one)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-11)


AROUND = {"itself": lambda body: body, "frozen rates": FrozenRates, "frozen": Frozen}
AROUND |= {"hybrid": lambda body: Hybrid(body, HoldState())}


@pytest.mark.parametrize("around", AROUND.values(), ids=AROUND)
def test_position_moves_with_the_true_velocity_where_the_log_s_lags(around):
    """An estimator that knows thrust alone has v̂˙ = R T e_z / m − g e_z + (v − v̂) / λ, the last across the thrust."""
    lag, (x, u) = 0.25, columns()
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
    derivative = field(jnp.eye(13)[3], jnp.sqrt(lifts / IRIS.thrust_coefficient))
    np.testing.assert_allclose(IRIS.mass * derivative[VELOCITY], pull, atol=1e-12)


@pytest.mark.parametrize(("mass", "centre"), [("mass", "centre_of_mass"), ("mass_ratio", "centre_shift")])
def test_a_learned_mass_or_load_is_that_of_a_heavier_vehicle(mass, centre):
    heavier, terms, shift = replace(IRIS, mass=1.3 * IRIS.mass), replace(KNOWN, centre_of_mass=(0.03, -0.03)), [2, -1]
    learned = RigidBody({mass: jnp.log(1.3), centre: 0.01 * np.array(shift) / units_of(IRIS)[centre]}, IRIS, KNOWN)
    np.testing.assert_allclose(learned.theta()[mass], heavier.mass if mass == "mass" else 1.3)
    x, u = columns()
    expected = one_by_one(rigid_body(heavier, (), terms), x, u)
    np.testing.assert_allclose(one_by_one(learned, x, u), expected, rtol=1e-13, atol=1e-13)


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
    x, u = columns(3)
    expected = one_by_one(RigidBody(logs, ODD), x, u) + added[:, None]
    body = RigidBody(logs, ODD, wrench=True)
    for field in (Hybrid(body, Push()), Hybrid(Hybrid(body, HoldState()), Push())):
        for evaluate in (one_by_one, train_batch, infer_batch):
            np.testing.assert_allclose(evaluate(field, x, u), expected, rtol=1e-12, atol=1e-11)
