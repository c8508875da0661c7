"""Laws of views: what a network cannot see changes nothing, what it may not write stays zero; and of rotors' thrust."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from choices import PAIRS, mostly_slow, slow
from surface import refusal
from systems import HOVER, columns, infer_batch, one_by_one, train_batch

from hybrid_jax import IRIS, AbstractVectorField, Frozen, Hybrid, Trajectories, residual_network, rigid_body, rotation
from hybrid_jax.dynamics import base
from hybrid_jax.networks import views, zero_output
from hybrid_jax.networks.standardise import with_scaling
from hybrid_jax.networks.views import INPUTS, RotorThrust, View, _nearness, multirotor_network
from hybrid_jax.sim.forces import ground_effect, parameters_of, rotor_altitudes
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, VELOCITY

pytestmark = pytest.mark.usefixtures("double_precision")  # laws hold to round-off

KEY = jax.random.key(0)
VIEWS = [pair for pair in PAIRS if pair[1] != "rotors"]  # these have laws of their own
FROM_THE_BODY = [pair for pair in VIEWS if pair[0] in views.FROM_THE_BODY]


def view(inputs="all", outputs="all", **options):
    known = {"vehicle": IRIS, "hidden": 9, "scaling": HOVER}
    return multirotor_network(key=KEY, inputs=inputs, outputs=outputs, **(known | options))


def turned(x, yaw):
    """States, or derivatives of states, turned about the world's vertical."""
    turn = jnp.broadcast_to(rotation.from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.asarray(yaw))[:, None], (4, 1))
    position, velocity = rotation.rotate(turn, x[POSITION]), rotation.rotate(turn, x[VELOCITY])
    return jnp.concatenate([position, rotation.multiply(turn, x[QUATERNION]), velocity, x[BODY_RATES]])


def network_of(field):
    return field if not isinstance(field, views.View) else network_of(field.field)


@pytest.mark.parametrize("norm", ["batch", "layer", "none"])
def test_by_default_the_network_is_the_paper_s(norm):
    plain = residual_network(13, 4, KEY, hidden=20, scaling=HOVER, norm=norm)
    assert eqx.tree_equal(multirotor_network(IRIS, KEY, hidden=20, scaling=HOVER, norm=norm), plain)
    assert eqx.tree_equal(multirotor_network(IRIS, KEY), residual_network(13, 4, KEY))


@pytest.mark.parametrize(("inputs", "outputs"), mostly_slow(pair for pair in VIEWS if pair[0] != "all"))
def test_where_the_vehicle_is_does_not_matter_and_how_high_may(inputs, outputs):
    field, (x, u) = view(inputs, outputs), columns()
    here = one_by_one(field, x, u)
    np.testing.assert_array_equal(one_by_one(field, x.at[:2].add(100.0), u), here)
    moves = jnp.abs(one_by_one(field, x.at[2].add(1.0), u) - here).max(0)
    assert (moves == 0).all() if inputs == "body_motion" else (moves > 1e-3).all()


@pytest.mark.parametrize(("inputs", "outputs"), mostly_slow(FROM_THE_BODY))
def test_seen_from_the_body_a_turned_vehicle_has_the_turned_derivative(inputs, outputs):
    field, (x, u) = view(inputs, outputs), columns()
    for yaw in (0.3, 2.0, -3.0):
        found, expected = one_by_one(field, turned(x, yaw), u), turned(one_by_one(field, x, u), yaw)
        np.testing.assert_allclose(found, expected, atol=1e-12)
    tilt = rotation.from_axis_angle(jnp.array([1.0, 0.0, 0.0]), jnp.asarray(0.3))
    tilted = x.at[QUATERNION].set(rotation.multiply(jnp.broadcast_to(tilt[:, None], (4, 6)), x[QUATERNION]))
    # Gravity has moved in the body, so this is another situation.
    assert (jnp.abs(one_by_one(field, tilted, u) - one_by_one(field, x, u))[BODY_RATES].max(0) > 1e-3).all()


@pytest.mark.parametrize("outputs", ["all", "accelerations"])
@pytest.mark.parametrize("inputs", ["no_xy_yaw", "near_ground"])
def test_without_yaw_a_turned_vehicle_is_the_same_in_the_axes_of_the_world(inputs, outputs):
    """The attitude alone is turned; the velocity, which a wind of the world acts on, is not."""
    field, (x, u) = view(inputs, outputs), columns()
    for yaw in (0.3, 2.0, -3.0):
        other = x.at[QUATERNION].set(turned(x, yaw)[QUATERNION])
        np.testing.assert_allclose(one_by_one(field, other, u), one_by_one(field, x, u), atol=1e-12)
        moved = one_by_one(field, x.at[VELOCITY].set(turned(x, yaw)[VELOCITY]), u)
        assert (jnp.abs(moved - one_by_one(field, x, u)).max(0) > 1e-3).all()
    seeing = view("no_xy", outputs)
    seen = one_by_one(seeing, turned(x, 1.0), u) - one_by_one(seeing, x, u)
    assert (jnp.abs(seen)[BODY_RATES].max(0) > 1e-3).all()


def test_a_view_that_cannot_be_is_refused():
    refusal(lambda: view(inputs="world"), "inputs must be one of", "'world'")
    refusal(lambda: view(norm="group"), "norm must be one of", "'group'")
    sizeless = replace(IRIS, rotor_radius=0.0)
    refusal(lambda: view(outputs="rotors", vehicle=sizeless), "vehicle.rotor_radius must be", "got 0")


def test_the_body_s_view_of_a_state_and_near_the_ground_each_rotor_is_as_high_as_in_the_simulator():
    """Nose down by a right angle about y: the world's down is the body's forward, the world's x the body's up."""
    q = rotation.from_axis_angle(jnp.array([0.0, 1.0, 0.0]), jnp.asarray(np.pi / 2))
    x = jnp.concatenate([jnp.array([5.0, 6.0, 7.0]), q, jnp.array([2.0, 3.0, 0.0]), jnp.array([0.1, 0.2, 0.3])])
    expected = [7, 1, 0, 0, 0, 3, 2, 0.1, 0.2, 0.3]
    np.testing.assert_allclose(View(rigid_body(IRIS), "body").read(x), expected, atol=1e-12)
    motion = [0, 3, 2, 0.1, 0.2, 0.3, -1, 0, 0]
    np.testing.assert_allclose(View(rigid_body(IRIS), "body_motion").read(x), motion, atol=1e-12)
    # Up to half a radius, below which both stop.
    x = columns()[0].at[2].set(jnp.linspace(-0.5, 1.0, 6))
    heights = jax.vmap(rotor_altitudes, (-1, None), -1)(x, parameters_of(IRIS).rotor_positions)
    near = IRIS.rotor_radius / jnp.maximum(heights, IRIS.rotor_radius / 2)
    assert (near.max(), near.min()) == (2, pytest.approx(0.1, abs=0.05))
    seen = view("near_ground").read(x)
    np.testing.assert_allclose(seen[1:5], near, atol=1e-6)  # the simulator's parameters are of single precision
    np.testing.assert_array_equal(jnp.delete(seen, np.arange(1, 5), axis=0), view("no_xy_yaw").read(x))


@pytest.mark.parametrize(("inputs", "outputs"), mostly_slow(VIEWS))
def test_a_linear_path_begins_silent_and_can_learn(inputs, outputs):
    field, (x, u) = view(inputs, outputs, linear=True), columns()
    assert (field.train_batch(x, u) == 0).all()
    slope = eqx.filter_jit(eqx.filter_grad(lambda residual: jnp.sum(one_by_one(residual, x, u))))(field)
    path = network_of(slope)
    assert (path.weight != 0).any()
    assert (path.field.weight_out != 0).any()
    moved = jax.tree.map(lambda leaf: leaf + 1, field)
    assert (one_by_one(zero_output(moved), x, u) == 0).all()
    refusal(lambda: zero_output(rigid_body(IRIS)), "no ResidualNetwork")


@pytest.mark.parametrize("inputs", INPUTS)
def test_what_accelerations_do_not_write_is_left_to_physics(inputs):
    field, (x, u), written = view(inputs, "accelerations"), columns(), 6
    for evaluate in (one_by_one, train_batch):
        derivative = evaluate(field, x, u)
        assert (derivative[:-written] == 0).all()
        assert (jnp.abs(derivative[-written:]).max(1) > 1e-3).all()
    assert network_of(field).weight_out.shape == (written, 9)


@pytest.mark.parametrize(("inputs", "outputs"), mostly_slow(VIEWS))
def test_in_training_a_view_sees_the_minibatch(inputs, outputs):
    field, (x, u) = view(inputs, outputs), columns(20)
    trained = field.train_batch(x, u)
    assert jnp.abs(trained - one_by_one(field, x, u)).max() > 1e-2

    def seen(node, x):
        return seen(node.field, node.read(x)) if isinstance(node, views.View) else x

    network = network_of(field)
    hidden = network.weight_in @ network.inputs(seen(field, x), u)
    here = base.RunningStats(hidden.mean(1), hidden.var(1))
    exact = eqx.tree_at(lambda field: network_of(field).norm.running, field, here)
    np.testing.assert_allclose(trained, one_by_one(exact, x, u), atol=1e-12)
    running = network_of(field.update_running_stats(x, u)).norm.running
    np.testing.assert_allclose(running.mean, 0.1 * here.mean, atol=1e-12)
    np.testing.assert_allclose(running.variance, 0.9 + 0.1 * here.variance, atol=1e-12)


@pytest.mark.parametrize("norm", ["batch", *slow("layer", "none")])
@pytest.mark.parametrize(("inputs", "outputs"), mostly_slow(VIEWS))
def test_deployed_on_columns_is_deployed_on_each(inputs, outputs, norm):
    x, u = columns()
    for field in (view(inputs, outputs, norm=norm), Hybrid(rigid_body(IRIS), view(inputs, outputs, norm=norm))):
        for same in (field, Frozen(field)):
            np.testing.assert_allclose(same.infer_batch(x, u), one_by_one(field, x, u), rtol=0, atol=1e-11)


class CheesemanBennett(AbstractVectorField):
    """T / T∞ − 1 of a rotor at R / h = x[0]."""

    def __call__(self, x, u):
        return 1 / (1 - (x / 4) ** 2) - 1


def shared():
    return RotorThrust(residual_network(1, 1, KEY, hidden=7, scaling=HOVER, norm="none"), IRIS)


def near_the_ground():
    x, u = columns()
    q = jnp.eye(4)[:, :1] + 0.1 * x[QUATERNION]
    return x.at[2].set(jnp.linspace(0.1, 1.0, 6)).at[QUATERNION].set(q / jnp.linalg.norm(q, axis=0)), u


def test_with_their_formula_it_is_the_simulator_s_ground_effect():
    x, u = near_the_ground()
    at_once = jax.vmap(ground_effect, (-1, -1, None, None), -1)
    force, torque = at_once(x, u, jnp.asarray(0.0), parameters_of(IRIS))
    turning = rotation.rotate(rotation.conjugate(x[QUATERNION]), torque) / np.array(IRIS.inertia)[:, None]
    found = one_by_one(RotorThrust(CheesemanBennett(), IRIS), x, u)
    assert np.abs(turning[:2]).max() > 1
    np.testing.assert_allclose(found[VELOCITY], force / IRIS.mass, atol=1e-5)
    np.testing.assert_allclose(found[BODY_RATES], turning, atol=1e-4)
    np.testing.assert_array_equal(found[: VELOCITY.start], 0)


def test_rotors_are_alike_also_in_a_batch_and_what_all_read_is_scaled_by_windows():
    """At one altitude an exchange of speeds is one of thrusts; equal ones push where the middle of the rotors is."""
    x, u = near_the_ground()
    for many in (train_batch, infer_batch):
        np.testing.assert_allclose(many(shared(), x, u), one_by_one(shared(), x, u), rtol=1e-4, atol=1e-4)
    level, u = jnp.eye(13)[3].at[2].set(0.2), jnp.array([600.0, 650.0, 700.0, 750.0])
    one, other = shared()(level, u), shared()(level, u[::-1])
    np.testing.assert_allclose(one[VELOCITY], other[VELOCITY], rtol=1e-5)
    same = shared()(level, jnp.full(4, 600.0))
    x, y = np.mean(IRIS.rotor_positions, axis=0)
    turning = IRIS.mass * same[9] * np.array([y, -x]) / np.array(IRIS.inertia[:2])
    assert abs(same[9]) > 0.01
    np.testing.assert_allclose(same[BODY_RATES][:2], turning, rtol=1e-3, atol=1e-4)
    x, u = near_the_ground()
    windows = Trajectories(x.T, u.T[:, None], x.T[:, None], 0.01)
    field = with_scaling(multirotor_network(IRIS, KEY, outputs="rotors", hidden=5), windows)
    np.testing.assert_allclose(field.physics.field.scaling.offset, [_nearness(x, IRIS).mean(), u.mean()], rtol=1e-5)


@pytest.mark.parametrize(("inputs", "outputs"), mostly_slow((inputs, "rotors") for inputs in INPUTS))
def test_beside_any_network_it_begins_silent_and_learns(inputs, outputs):
    known = {"inputs": inputs, "hidden": 5, "scaling": HOVER}
    (x, u), field = near_the_ground(), multirotor_network(IRIS, KEY, outputs=outputs, **known)
    alone = multirotor_network(IRIS, KEY, outputs="accelerations", **known)
    np.testing.assert_array_equal(one_by_one(field, x, u), one_by_one(alone, x, u))
    slope = eqx.filter_jit(eqx.filter_grad(lambda residual: jnp.sum(residual.train_batch(x, u))))(field)
    assert (slope.physics.field.weight_out != 0).any()
