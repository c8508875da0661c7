"""Laws of the controller on single calls, of the Jacobians that it needs, and of the references that it follows."""

import dataclasses
from dataclasses import replace
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from choices import slow
from surface import refusal
from systems import HOVER, flying

import hybrid_jax as hj
from hybrid_jax.control import (
    Controller,
    Weights,
    add_body_rates,
    advance,
    figure_eight,
    hover,
    low_flyby,
    sample,
    step,
)
from hybrid_jax.control.sensitivities import advance_lagged, advance_with_jacobian, condensed, stage_shares, step_of
from hybrid_jax.dynamics import ConstantDisturbance, Frozen
from hybrid_jax.networks import LinearResidual, multirotor_network
from hybrid_jax.rotation import body_z, from_axis_angle, heading, normalise

# With equal arms hover needs equal speeds.
VEHICLE = dataclasses.replace(hj.IRIS, rotor_positions=((0.15, -0.2), (-0.15, 0.2), (0.15, 0.2), (-0.15, -0.2)))
LOWEST = 100.0  # rad/s
CONTROLLER = Controller(VEHICLE, min_speed=LOWEST)
BODY = hj.rigid_body(VEHICLE)


@eqx.filter_jit
def call(model, reference, x, plan, iterations):
    """The number of iterations is traced, so that all share one program."""
    return Controller(VEHICLE, min_speed=LOWEST, iterations=iterations)(model, reference, x, plan)


def command(x, reference, plan=None, model=BODY, iterations=1):
    return call(model, reference, x, CONTROLLER.begin() if plan is None else plan, jnp.asarray(iterations))


@pytest.fixture(scope="module")
def still():
    reference = sample(hover((1.0, -2.0, 3.0)), CONTROLLER, 0.01)
    return reference[0], CONTROLLER.horizon(reference, 0)


@pytest.mark.parametrize("network", [False, True])
def test_q_and_minus_q_give_the_same_command(network, still):
    model = hj.Hybrid(BODY, hj.residual_network(13, 4, jax.random.key(0), hidden=8)) if network else BODY
    x, reference = still
    x = x.at[3:7].set(normalise(jnp.array([0.8, 0.3, -0.2, 0.5])))
    plan = opposite = None
    for _ in range(3):
        u, plan = command(x, reference, plan, model)
        again, opposite = command(x.at[3:7].multiply(-1), reference, opposite, model)
        np.testing.assert_array_equal(u, again)
        # The sign of the reference does not matter either; only rounding may differ.
        third, _ = command(x, reference.at[:, 3:7].multiply(-1), plan, model)
        np.testing.assert_allclose(third, command(x, reference, plan, model)[0], rtol=1e-5)


@pytest.mark.parametrize("cosine", [0.0, 1e-7, -1e-7])
def test_half_a_turn_of_yaw_is_corrected(still, cosine):
    x, reference = still
    x = x.at[3:7].set(jnp.array([cosine, 0.0, 0.0, 1.0]))
    u, _ = command(x, reference, iterations=6)
    torque = np.sum(np.array(VEHICLE.spin) * np.asarray(u) ** 2)
    # More than half of the largest yaw torque at hover thrust, in either direction.
    assert abs(torque) > 0.5 * 4 * VEHICLE.hover_speed**2


def test_speeds_reach_the_limits_and_stay_within_and_more_iterations_never_raise_the_cost(still):
    x, reference = still
    plan, found = None, []
    for away in (30.0, 3000.0, -30.0, -3000.0):
        _, plan = command(x.at[:3].add(away), reference, plan, iterations=4)
        found.append(CONTROLLER.speeds(plan))
    lowest, highest = np.min(found), np.max(found)
    assert LOWEST <= lowest < LOWEST + 10.0
    assert VEHICLE.max_rotor_speed - 10.0 < highest <= VEHICLE.max_rotor_speed
    x, reference = still
    turned = x.at[3:7].set(from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.array(2.5)))
    for start in (add_body_rates(x, (5.0, -6.0, 4.0)), turned, x.at[:3].add(3.0)):
        costs = np.array([command(start, reference, iterations=n)[1].cost for n in range(1, 13)])
        assert (np.diff(costs) <= 0).all()
        assert costs[-1] < 0.95 * costs[0]


def test_quaternion_length_is_ignored_if_traced_and_refused_if_concrete_as_are_invalid_shapes(still):
    x, reference = still
    x = x.at[3:7].set(normalise(jnp.array([0.8, 0.3, -0.2, 0.5])))
    for factor in (0.5, 1.1):
        long = x.at[3:7].multiply(factor)
        np.testing.assert_allclose(command(long, reference)[0], command(x, reference)[0], rtol=1e-4)
    for factor in (0.0, 1.1):
        with pytest.raises(ValueError, match=r"x\[3:7\] must be a unit quaternion"):
            CONTROLLER(BODY, reference, x.at[3:7].multiply(factor), CONTROLLER.begin())
    with pytest.raises(ValueError, match=r"reference\[2, 3:7\] must be a unit quaternion"):
        CONTROLLER(BODY, reference.at[2, 3:7].multiply(2.0), x, CONTROLLER.begin())
    x, reference = still
    refusal(lambda: CONTROLLER(BODY, reference[:-1], x, CONTROLLER.begin()), "reference")
    refusal(lambda: CONTROLLER(BODY, reference, x.at[0].set(jnp.nan), CONTROLLER.begin()), "finite")
    refusal(lambda: CONTROLLER(None, reference, x, CONTROLLER.begin()), "model must be a vector field, got None")
    with pytest.raises(ValueError, match=r"plan must have variables of shape \(20, 4\), got \(10, 4\)"):
        CONTROLLER(BODY, reference, x, Controller(VEHICLE, steps=10).begin())


REGULAR = Controller(hj.IRIS)
DT = REGULAR.period


@pytest.fixture(scope="module")
def states():
    def spiral(t):
        return jnp.stack([jnp.sin(t), jnp.cos(2 * t), 0.3 * t**2]), jnp.sin(2 * t)

    with jax.enable_x64(True):
        return np.asarray(sample(spiral, REGULAR, 1.0))


def test_samples_cover_the_last_horizon_and_their_velocity_rates_and_attitude_are_those_of_the_path(states):
    assert len(states) == 100 + REGULAR.steps * REGULAR.stride + 1
    horizon = REGULAR.horizon(jnp.asarray(states), 100)
    np.testing.assert_allclose(horizon[-1], states[-1], rtol=1e-6)
    np.testing.assert_allclose(horizon[0], states[105], rtol=1e-6)
    refusal(lambda: REGULAR.horizon(jnp.asarray(states), 101), "i ≤ 100; got 101")
    refusal(lambda: REGULAR.horizon(jnp.asarray(states), -1), "i must be an integer of at least 0, got -1")
    # Central differences of second order: 1e-4 of the third derivatives, which are below 20.
    np.testing.assert_allclose((states[2:, :3] - states[:-2, :3]) / (2 * DT), states[1:-1, 7:10], rtol=0, atol=1e-3)
    turning = (states[2:, 3:7] - states[:-2, 3:7]) / (2 * DT)
    found = np.array([hj.rigid_body(hj.IRIS)(x, np.zeros(4, np.float32))[3:7] for x in states[1:-1:10]])
    np.testing.assert_allclose(turning[::10], found, rtol=0, atol=2e-3)
    acceleration = (states[2:, 7:10] - states[:-2, 7:10]) / (2 * DT) + [0, 0, hj.IRIS.gravity]
    asked = acceleration / np.linalg.norm(acceleration, axis=1, keepdims=True)
    np.testing.assert_allclose(np.asarray(body_z(states[1:-1, 3:7].T)).T, asked, rtol=0, atol=1e-3)
    np.testing.assert_allclose(heading(jnp.asarray(states[:, 3:7])), np.sin(2 * DT * np.arange(len(states))), atol=1e-6)
    np.testing.assert_allclose(normalise(states[:, 3:7]), states[:, 3:7], atol=1e-6)


def test_references_have_the_speed_that_they_say_and_a_low_flyby_is_low_for_two_fifths_of_the_time():
    for speed in (3.5, 6.0):
        flown = np.linalg.norm(sample(figure_eight(speed), REGULAR, 10.0)[:, 7:10], axis=1)
        assert (flown.max() == pytest.approx(speed, rel=1e-3), flown.min() > 0.3 * speed) == (True, True)
    samples = sample(step(to=(2.0, 0.0, 1.0), at=0.5, yaw=1.0, altitude=1.5), REGULAR, 1.0)
    np.testing.assert_array_equal(samples[:, 7:], 0)
    np.testing.assert_allclose(samples[0], sample(hover((0.0, 0.0, 1.5)), REGULAR, 1.0)[0])
    np.testing.assert_allclose(samples[-1], sample(hover((2.0, 0.0, 2.5), yaw=1.0), REGULAR, 1.0)[0], atol=1e-6)
    altitude = np.asarray(sample(low_flyby(low=0.15, high=1.0, every=5.0), REGULAR, 9.0)[:, 2])
    assert altitude.min() == pytest.approx(0.15, abs=1e-4)
    assert altitude.max() == pytest.approx(1.0, abs=1e-4)
    assert np.mean(altitude < 0.15 + 0.085) == pytest.approx(0.4, abs=0.03)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: hover((0.0, 0.0)), r"position must be three numbers \(x, y, z\), got \(0.0, 0.0\)"),
        (lambda: hover((0.0, 0.0, np.nan)), r"position\[2\] is not finite"),
        (lambda: hover(yaw=np.inf), "yaw must be a finite number"), (lambda: low_flyby(low=1.0, high=0.5), "high"),
        (lambda: sample(hover(), REGULAR, -1.0), "duration"), (lambda: figure_eight(0.0), "top_speed"),
        (lambda: add_body_rates(jnp.zeros(4)), r"state \(13,\) expected"),
        (lambda: sample(None, REGULAR, 1.0), "path must be a function of time"), (lambda: Weights(yaw=0.0), "yaw"),
        (lambda: Controller(hj.IRIS, steps=1), "steps"), (lambda: Controller(hj.IRIS, min_speed=700.0), "hover speed"),
        *((lambda dt=dt: Controller(hj.IRIS, interval=dt), "interval must be a multiple") for dt in (0.055, 0.005)),
        (lambda: Controller(hj.IRIS, weights={"yaw": 1.0}), r"weights must be a Weights, got \{'yaw': 1.0\}"),
    ],
)  # fmt: skip
def test_invalid_arguments_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()


INTERVAL = 0.05


def network(inputs="all", outputs="all", norm="batch", linear=False):
    known = {"hidden": 8, "scaling": HOVER, "vehicle": hj.IRIS}
    made = multirotor_network(key=jax.random.key(1), inputs=inputs, outputs=outputs, norm=norm, linear=linear, **known)
    return jax.tree.map(lambda leaf: leaf + 0.3 + 0.2 * jnp.sin(jnp.arange(leaf.size)).reshape(leaf.shape), made)


class Spun(hj.AbstractVectorField):
    def __call__(self, x, u):
        return jnp.sin(x) + jnp.concatenate([x[5:9] * u / 600, x[:9]])


@cache
def body():
    return hj.RigidBody({"Ix": jnp.asarray(0.1), "Iy": jnp.asarray(-0.2), "k": jnp.asarray(0.05)}, hj.IRIS)


def invariant():
    forced = replace(body(), wrench=True)
    return hj.Hybrid(forced, network("near_ground", "rotors", "none", linear=True))


FIELDS = {
    "physics": body, "paper": lambda: hj.Hybrid(body(), network()),
    "layer norm": lambda: hj.Hybrid(body(), network(norm="layer")),
    "no x, y": lambda: hj.Hybrid(body(), network("no_xy", norm="none")),
    "body frame": lambda: hj.Hybrid(body(), network("body", "accelerations")),
    "invariant, disturbed": lambda: hj.Hybrid(invariant(), ConstantDisturbance(jnp.ones(6))),
    "frozen": lambda: hj.Hybrid(body(), Frozen(LinearResidual(jnp.ones((13, 17)) / 50, jnp.ones(13)))), "user": Spun,
}  # fmt: skip


LONG_TO_COMPILE = ("paper", "layer norm", "body frame", "invariant, disturbed")


@pytest.mark.parametrize("name", [name for name in FIELDS if name not in LONG_TO_COMPILE] + slow(*LONG_TO_COMPILE))
def test_jacobian_of_a_step_equals_autodiff(name):
    def both(field, x, u):
        expected = jnp.concatenate(jax.jacfwd(partial(advance, field), argnums=(0, 1))(x, u, INTERVAL), axis=1)
        return advance_with_jacobian(field, x, u, u, 0.0, INTERVAL), (advance(field, x, u, INTERVAL), expected)

    with jax.enable_x64(True):
        field = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), FIELDS[name]())
        x, u = map(jnp.asarray, flying(3))
        x = x.at[:, 2].set(jnp.array([0.2, 0.6, 1.0]))
        found, expected = jax.jit(jax.vmap(both, in_axes=(None, 0, 0)))(field, x, u)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * float(jnp.abs(other).max()))


@pytest.mark.parametrize("lag", [0.005, 0.03, 0.2, 4.9, 5.1])
def test_a_step_is_exact_for_a_chain_of_integrators_of_a_lagging_input(lag):
    start, dt = jnp.array([0.3, -0.2, 0.1]), INTERVAL
    with jax.enable_x64(True):
        shares = stage_shares(lag, dt)
        found = step_of(lambda x, f: jnp.stack([x[1], x[2], f]), jnp.asarray(start, float), shares, dt)
    s = np.linspace(0, dt, 20_001)
    moments = [np.trapezoid((dt - s) ** k / (1, 1, 2)[k] * np.exp(-s / lag), s) for k in (2, 1, 0)]
    a, b, c = np.asarray(start, float)
    expected = np.array([a + b * dt + c * dt**2 / 2, b + c * dt, c]) + moments
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("lag", [0.04, 0.0])
def test_derivatives_by_commands_of_lagging_rotors_equal_autodiff(lag):
    dt, body = 0.05, FIELDS["physics"]()

    def states(commands, x, speeds):
        def interval(start, command):
            start = advance_lagged(body, *start, command, lag, dt)
            return start, start[0]

        return jax.lax.scan(interval, (x, speeds), commands)[1]

    @jax.jit
    def both(commands, x, speeds):
        path = jnp.concatenate([x[None], states(commands, x, speeds)])
        found = condensed(body, path[:-1], speeds, commands, lag, dt)
        return found, jax.jacfwd(states)(commands, x, speeds)

    with jax.enable_x64(True):
        x, u = map(jnp.asarray, flying(3))
        found, expected = both(u, x[0], u[1])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(np.asarray(expected)).max())
