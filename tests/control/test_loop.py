"""Laws of the closed loop, with a rigid body as the plant, and of its observer."""

from dataclasses import replace
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import HOVER

import hybrid_jax as hj
from hybrid_jax import control
from hybrid_jax.control.cost import deviations
from hybrid_jax.dynamics import ConstantDisturbance, DisturbanceModel, RandomWalk

CONTROLLER = control.Controller(hj.IRIS)
BODY = hj.rigid_body(hj.IRIS)
WIND = np.array([0.0, -4 / 1.5, 0.0, 0.0, 0.0, 0.0], np.float32)  # m/s²: the mean of experiment 2's
DT = 0.01
TRUE = jnp.array([0.0, -4 / 1.5, 0.5, 0.3, -0.2, 0.1])


def plant(field):
    return lambda x, u, t: control.advance(field, x, u, CONTROLLER.period)


def simulate(wind, reference, x0, bandwidth, kick):
    """A flight whose body rates jump at the time `kick`."""

    def kicked(x, u, t):
        x = plant(hj.Hybrid(BODY, ConstantDisturbance(wind)))(x, u, t)
        return jnp.where(jnp.abs(t - kick) < 0.5 * CONTROLLER.period, control.add_body_rates(x), x)

    flight = control.fly(kicked, BODY, reference, x0, CONTROLLER, bandwidth)
    return flight, control.performance(flight, reference, CONTROLLER)


alone = jax.jit(simulate)  # one program for all flights of 2 s
NEVER = -1.0
PATHS = {"hover": control.hover(), "eight": control.figure_eight(3.5), "fast eight": control.figure_eight(6.0)}
PATHS |= {"low pass": control.low_flyby()}


@cache
def reference_of(name):
    return control.sample(PATHS[name], CONTROLLER, 2.0)


@pytest.mark.parametrize(("name", "allowed"), [*zip(PATHS, (0.001, 0.001, 0.005, 0.002), strict=True)])
def test_true_model_tracks_the_reference(name, allowed):
    _, found = alone(np.zeros(6), reference_of(name), reference_of(name)[0], 0.0, NEVER)
    assert found.position_rmse < allowed
    assert found.yaw_rmse < 0.002
    assert not found.crashed


def test_recovery_from_a_rate_of_6_rad_per_s_and_damping_does_not_grow_at_the_optimum():
    reference = control.sample(control.hover((0.0, 0.0, 3.0)), CONTROLLER, 2.0)
    flight, found = alone(np.zeros(6), reference, control.add_body_rates(reference[0]), 0.0, NEVER)
    assert found.largest_error < 0.3
    away = np.abs(flight.x[-1] - reference[0])
    assert away[:3].max() < 0.02
    assert away[7:].max() < 0.1
    reference = reference_of("hover")
    early, late = (alone(np.zeros(6), reference, reference[0], 0.0, at)[1].largest_error for at in (0.0, 1.0))
    assert late < 1.03 * early


def test_observer_finds_the_wind_and_removes_its_error_as_does_a_model_with_a_past():
    reference = reference_of("hover")
    _, without = alone(WIND, reference, reference[0], 0.0, NEVER)
    flight, found = alone(WIND, reference, reference[0], 10.0, NEVER)
    np.testing.assert_allclose(flight.estimates.disturbance[-1], WIND, rtol=0, atol=0.01)
    assert without.position_rmse > 0.1
    assert found.position_rmse < 0.3 * without.position_rmse
    assert np.linalg.norm(flight.x[-1, :3] - reference[0, :3]) < 0.01
    # This one takes the last error, filtered over 0.1 s, for the next.
    model = DisturbanceModel(BODY, jnp.eye(12, 13), jnp.ones(13), (0.1,), ())
    reference = reference_of("hover")
    pushed = plant(hj.Hybrid(BODY, ConstantDisturbance(WIND)))
    flight = jax.jit(lambda: control.fly(pushed, model, reference, reference[0], CONTROLLER))()
    flown = hj.Trajectories(flight.x[None, 0], flight.u[None], flight.x[None, 1:], CONTROLLER.period)
    np.testing.assert_allclose(flight.estimates, hj.observe(model, flown)[0, :-1], atol=2e-3)
    np.testing.assert_allclose(flight.estimates[-1, 13 + 6 :], WIND, atol=0.02)
    assert np.linalg.norm(flight.x[-1, :3] - reference[0, :3]) < 0.01


def test_a_filter_of_a_hidden_force_removes_the_wind():
    """The controller plans with the force that the filter estimates from noisy positions and attitudes."""
    field, reference = hj.with_hidden(BODY, RandomWalk((7, 8, 9))), reference_of("hover")
    spread, walk = (*np.full(12, 0.1), 3.0, 3.0, 3.0), (*np.zeros(12), 0.3, 0.3, 0.3)
    system = hj.StateSpaceModel(field, ("u",), start=(*reference[0], 0, 0, 0), spread=spread, process=walk)
    noise = {"position": 0.002, "attitude": 0.004, "velocity": 0.02, "body rates": 0.02}
    kalman = hj.ExtendedKalmanFilter(replace(system.only(noise), noise=noise), CONTROLLER.period)
    pushed = plant(hj.Hybrid(BODY, ConstantDisturbance(WIND)))
    given = {"hardware": control.Hardware(noise=(0.002, 0.002, 0.02, 0.02)), "key": jax.random.key(0)}
    flown = partial(control.fly, pushed, field, reference, reference[0], CONTROLLER, estimator=kalman, **given)
    flight = jax.jit(flown)()
    np.testing.assert_allclose(flight.estimates.x[-1, 13:], WIND[:3], atol=0.3)
    assert np.linalg.norm(flight.x[-1, :3] - reference[0, :3]) < 0.02


@pytest.mark.parametrize("end", [(0.0, 0.0, -0.1), (11.0, 0.0, 1.0), (np.nan, 0.0, 1.0)])
def test_performance_of_known_flights_and_crashes_below_ground_too_far_or_not_finite(end):
    reference, u = control.sample(control.hover(), CONTROLLER, 0.1), jnp.full((4, 4), hj.IRIS.hover_speed)
    flight = control.Flight(jnp.tile(reference[0], (5, 1)), u, CONTROLLER.begin(), None, u)
    ended = eqx.tree_at(lambda f: f.x, flight, flight.x.at[3, :3].set(jnp.array(end)))
    assert control.performance(ended, reference, CONTROLLER).crashed
    flight = eqx.tree_at(lambda f: f.x, flight, flight.x.at[2:, 1].add(jnp.array([0.3, 0.0, 0.4])))
    flight = eqx.tree_at(lambda f: f.u, flight, flight.u.at[0, 0].set(1099.0).at[1, 1].set(1.0))
    found = control.performance(flight, reference, CONTROLLER)
    assert found.position_rmse == pytest.approx(0.25, rel=1e-5)
    assert found.largest_error == pytest.approx(0.4, rel=1e-5)
    assert found.saturation == 2 / 16
    assert found.yaw_rmse == 0
    assert not found.crashed
    # The yaw error wraps.
    behind, ahead = (control.sample(control.hover(yaw=yaw), CONTROLLER, 0.1) for yaw in (np.pi - 0.1, -np.pi + 0.1))
    flight = eqx.tree_at(lambda f: f.x, flight, ahead[:5])
    assert control.performance(flight, behind, CONTROLLER).yaw_rmse == pytest.approx(0.2, rel=1e-4)


def test_invalid_arguments_hardware_and_hidden_states_that_nothing_estimates_are_refused():
    reference = reference_of("hover")
    for x0, samples in ((reference[0, :4], reference), (reference[0], reference[0]), (reference[0], reference[:101])):
        with pytest.raises(ValueError, match="reference"):
            control.fly(plant(BODY), BODY, samples, x0, CONTROLLER)
    with pytest.raises(ValueError, match=r"x0\[3:7\] must be a unit quaternion"):
        control.fly(plant(BODY), BODY, reference, reference[0].at[3:7].set(0.0), CONTROLLER)
    with pytest.raises(ValueError, match="bandwidth must be a finite number of at least 0"):
        control.fly(plant(BODY), BODY, reference, reference[0], CONTROLLER, jnp.asarray(-1.0))
    lagging = hj.with_hidden(BODY, hj.dynamics.Lag(jnp.log(jnp.full(4, 0.05)), (0, 1, 2, 3)))
    model, reference = DisturbanceModel(BODY, jnp.eye(12, 13), jnp.ones(13), (0.1,), ()), reference_of("hover")
    for bandwidth, field, message in ((0.0, lagging, "hidden states"), (1.0, model, "bandwidth must be 0")):
        with pytest.raises(ValueError, match=message):
            control.fly(plant(BODY), field, reference, reference[0], CONTROLLER, bandwidth)
    with pytest.raises(ValueError, match=r"x \(25,\) and reference"):
        CONTROLLER(model, CONTROLLER.horizon(reference, 0), reference[0], CONTROLLER.begin())
    for options in ({"latency": -1.0}, {"rotor_lag": np.nan}, {"noise": (0.1,)}, {"noise": (-1.0, 0.0, 0.0, 0.0)}):
        with pytest.raises(ValueError, match=next(iter(options))):
            control.Hardware(**options)
    with pytest.raises(ValueError, match="latency must be a multiple"):
        control.Hardware(latency=0.015).delay(0.01)
    noisy = control.Hardware(noise=(0.1, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="key must be"):
        control.fly(plant(BODY), BODY, reference_of("hover"), reference_of("hover")[0], CONTROLLER, hardware=noisy)


@pytest.mark.parametrize(("start", "wanted"), [(np.float32, np.float64), (np.float64, np.float32)])
def test_mixed_precision_is_promoted(start, wanted):
    with jax.enable_x64(True):
        controller, body = control.Controller(hj.IRIS, steps=2), hj.rigid_body(hj.IRIS)
        reference = np.asarray(control.sample(control.hover(), controller, 0.02), wanted)

        def fly(reference, x0):
            return control.fly(lambda *given: plant(body)(*given).astype("f4"), body, reference, x0, controller).x

        assert jax.eval_shape(fly, reference, reference[0].astype(start)).dtype == np.float64


def test_a_controller_that_knows_the_lag_predicts_its_costs_and_pays_less():
    """It need not track closer: position costs beside rates and changes of inputs. Without lag and latency, too, the
    position RMSE is 2.4 mm; a controller that ignores them has 1.7 mm, by inputs that change more."""
    late, reference = control.Hardware(latency=0.02, rotor_lag=0.05), reference_of("fast eight")

    def flown(own):
        flight = control.fly(plant(BODY), BODY, reference, reference[0], own, hardware=late)
        wanted, shares = reference[1 : len(flight.x)], flight.u / (hj.IRIS.max_rotor_speed / 2)
        found = jax.vmap(partial(deviations, own.weights))(wanted, flight.x[1:])
        changes = shares[own.stride :] - shares[: -own.stride]
        costs = control.open_loop_costs(plant(BODY), flight, reference, own, range(60, len(flight.u), 30), late)
        paid = jnp.mean(jnp.sum(jnp.square(found), 1)) + jnp.mean(jnp.sum(jnp.square(changes), 1))
        return costs, paid, control.performance(flight, reference, own)

    own = control.Controller(hj.IRIS, rotor_lag=late.rotor_lag)
    (costs, paid, found), (others, more, _) = (jax.jit(partial(flown, each))() for each in (own, CONTROLLER))
    # A plan begins when its command arrives, with the rotors as they turn by then.
    np.testing.assert_allclose(costs[1], costs[0], rtol=0.02)
    assert (others[1] > 10 * others[0]).all()
    assert paid < 0.9 * more
    assert found.position_rmse < 0.004


def test_a_command_arrives_late_and_the_rotors_follow():
    late = control.Hardware(latency=0.02, rotor_lag=0.05)
    own = control.Controller(hj.IRIS, rotor_lag=0.05)
    reference, seen = reference_of("eight"), []
    loop = control.Loop(own, late, control.Observer(BODY, 0.0, own.period))
    now = loop.begin(reference[0], own.begin(), jax.random.key(0))
    tick = jax.jit(lambda now, i: loop.tick(lambda x, u, t: x.at[:4].set(u), reference, now, i))
    start, commands = now.speeds, []
    for i in range(4):
        now, u = tick(now, i)
        seen.append(now.x[:4])
        commands.append(u)
    np.testing.assert_allclose(seen[1], start, rtol=1e-6)  # the first command is still on its way
    share = 1 - 0.05 / 0.01 * -np.expm1(-0.01 / 0.05)  # of the way that the mean over a period goes
    np.testing.assert_allclose(seen[2] - start, share * (commands[0] - start), rtol=1e-3, atol=1e-3)


@eqx.filter_jit
def watch(field, plant, bandwidth, sign, periods=100):
    """Estimates over a flight of the plant at random speeds; the observer sees quaternions of this sign."""
    speeds = hj.IRIS.hover_speed + 20 * jax.random.normal(jax.random.key(0), (periods, 4))

    def tick(carry, u):
        x, state = carry
        x = control.advance(plant, x, u, DT)
        return (x, observer.update(state, x.at[3:7].multiply(sign), u)), state.disturbance

    observer, x0 = control.Observer(field, bandwidth, DT), jnp.eye(13)[2] * 2 + jnp.eye(13)[3]
    return jax.lax.scan(tick, (x0, observer.begin(x0.at[3:7].multiply(sign))), speeds)[1]


NETWORK = hj.residual_network(13, 4, jax.random.key(0), hidden=8, scaling=HOVER)
FIELDS = {"physics": BODY, "hybrid": hj.Hybrid(BODY, NETWORK), "network": NETWORK}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("name", "bandwidth"), [("physics", 5.0), ("hybrid", 5.0), ("network", 5.0), ("physics", 0.0)])
def test_estimate_converges_at_the_bandwidth_whatever_the_quaternion_s_sign(name, bandwidth, sign):
    given = hj.Hybrid(FIELDS[name], ConstantDisturbance(TRUE)), jnp.asarray(bandwidth), jnp.asarray(sign)
    found = watch(FIELDS[name], *given)
    share = -np.expm1(-bandwidth * DT * np.arange(100))[:, None]
    # Rounding of v and ω over DT: 1e-6 / 0.01, more where a network's speeds are large.
    np.testing.assert_allclose(found, share * TRUE, rtol=0, atol=2e-2 if bandwidth else 0)
