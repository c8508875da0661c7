"""A sound flight passes every check; each usual mistake is caught by the check for it, which names the correction."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import log_mistakes
from hybrid_jax.flights.checks.cleaning import delay
from hybrid_jax.flights.checks.consistency import FAILS, NEED_VEHICLE, NOTHING, OK, UNKNOWN, WARNS, check_log
from hybrid_jax.flights.checks.motor_response import orders
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.vehicle import IRIS

VELOCITY, RATES, THRUST = "dp/dt against v", "q̇ against ω", "v̇ against thrust along body z"
RATIO, ORDER = "specific force over thrust per mass", "motor order against roll and pitch"
COLUMNS, UPWARDS = "columns", [1, 1, -1]
YAW, LAG = "spin against yaw", "lag of the gyro behind the motors"


def table(log, **vehicle):
    return {check.name: check for check in check_log(log, replace(IRIS, **vehicle))}


def with_parts(log, p=None, v=None, omega=None, u=None):
    x = log.x.copy()
    for place, part in ((slice(0, 3), p), (slice(7, 10), v), (slice(10, 13), omega)):
        x[:, place] = x[:, place] if part is None else part
    return FlightLog(log.t, x, log.u if u is None else u)


def noisy(log, rng):
    """Sensors of a small quadrotor."""
    x = log.x + rng.normal(size=log.x.shape) * np.repeat([1e-3, 2e-3, 0.02, 0.03], [3, 4, 3, 3])
    return FlightLog(log.t, x, log.u + rng.normal(size=log.u.shape))


@pytest.mark.parametrize("noise", [False, True])
def test_a_sound_flight_passes(flight, noise):
    log = noisy(flight, np.random.default_rng(0)) if noise else flight
    for check in check_log(log, IRIS):
        assert (check.verdict, check.suggestion) == (OK, NOTHING), check


def test_a_velocity_that_never_climbs_is_found(flight):
    """Beside the mistakes of benchmarks/log_mistakes, which are planted below."""
    log = noisy(flight, np.random.default_rng(1))
    log = with_parts(log, v=log.x[:, 7:10] * [1, 1, 0])
    for name, words in ((VELOCITY, "only z"), (COLUMNS, "vz never changes")):
        assert (table(log)[name].verdict, words in table(log)[name].suggestion) == (FAILS, True)
    alone = [check for check in check_log(log, IRIS) if check.name not in NEED_VEHICLE]
    assert list(map(repr, check_log(log))) == list(map(repr, alone))  # a NaN is no equal of itself


@pytest.mark.parametrize("order", orders(4).tolist(), ids=str)
def test_order_of_motors_is_found(flight, order):
    check = table(with_parts(flight, u=flight.u[:, order]))[ORDER]
    back = " ".join(f"u{order.index(rotor)}" for rotor in range(4))
    assert check.suggestion == NOTHING if order == [0, 1, 2, 3] else back in check.suggestion


def test_a_spin_is_not_refused_for_an_inertia_that_may_be_an_estimate(flight):
    """While it rolls steadily, an Iy twice too large makes of pitch a torque about yaw that is against the motors."""
    (ix, _, iz), t = IRIS.inertia, flight.t
    roll, yaw = 2 + 0.3 * np.sin(20 * t), 0.1 * np.sin(12 * t)
    omega = np.stack([roll, -1.5 * iz / ix * np.gradient(yaw, t) / roll, yaw], axis=1)
    torque = IRIS.inertia * np.gradient(omega, t, axis=0) + np.cross(omega, IRIS.inertia * omega)
    arms, k = np.array(IRIS.rotor_positions), IRIS.thrust_coefficient
    mix = np.stack([k + 0 * arms[:, 0], k * arms[:, 1], -k * arms[:, 0], IRIS.torque_coefficient * np.array(IRIS.spin)])
    u = np.sqrt(np.linalg.solve(mix, np.column_stack([15 + 0 * t, torque]).T).T)
    log = with_parts(flight, omega=omega, u=u)
    for wrong, spin, verdict, words in (
        (1.0, IRIS.spin, OK, NOTHING),
        (2.0, IRIS.spin, WARNS, "Iy − Ix: check its inertia"),
        (1.0, tuple(-sign for sign in IRIS.spin), FAILS, "flip"),
    ):
        found = table(log, inertia=(ix, wrong * ix, iz), spin=spin)[YAW]
        assert (found.verdict, words in found.suggestion) == (verdict, True), found


@pytest.mark.parametrize("spin", [(1, 1, -1, 1), (1, 1, 1, 1), tuple(-sign for sign in IRIS.spin)], ids=str)
def test_unbalanced_and_reversed_spins_are_found(flight, spin):
    checks = table(flight, spin=spin)
    words = "half of its rotors" if sum(spin) else "flip"
    assert checks[ORDER].verdict == OK
    assert (checks[YAW].verdict, words in checks[YAW].suggestion) == (FAILS, True)


def test_gusts_and_loads_warn_and_say_that_the_vehicle_may_have_changed_and_steady_wind_fails_no_check(flight):
    """A force that no thrust explains, along each axis or downwards with speed, as a load or a wing makes it."""
    rng, t = np.random.default_rng(0), flight.t
    gusts = np.cumsum(rng.normal(0, 0.5, (len(t), 3)), axis=0)
    gusts = 3 * (gusts - gusts.mean(axis=0)) / gusts.std(axis=0)
    speed = np.cumsum(gusts, axis=0) * 0.01
    drift = np.cumsum(speed, axis=0) * 0.01
    found = table(with_parts(flight, flight.x[:, :3] + drift, v=flight.x[:, 7:10] + speed))
    assert {check.verdict for check in found.values()} <= {OK, WARNS}
    assert "or the vehicle has changed (wind, load, damage): adapt" in found[THRUST].suggestion
    for mass, verdict in ((1.8, WARNS), (1.1, OK), (4.0, FAILS)):
        check = table(flight, mass=IRIS.mass / mass)[RATIO]
        assert (check.verdict, "vehicle has changed" in check.suggestion) == (verdict, verdict == WARNS)
    # External forces may dominate one axis; the log is correct all the same.
    still = [0, 1, 1]  # along x the rotors move it, but it does not move
    check = table(with_parts(flight, flight.x[:, :3] * still, v=flight.x[:, 7:10] * still))[THRUST]
    assert (check.verdict, check.value > 0.3) == (OK, True)


@pytest.mark.parametrize("part", [1e-3, 0.05])
def test_another_reading_that_fits_a_hair_better_is_no_mistake(flight, part):
    """dp/dt agrees with v, so it is not in the body; an estimate of 40 ms late is common and borne."""
    log = with_parts(flight[4:], v=flight.x[4:, 7:10] * (1 - part) + part * flight.x[:-4, 7:10])
    assert table(log)[VELOCITY].verdict == OK
    pushed = np.array(flight.x[:, 7:10]) - 0.1 * np.abs(flight.x[:, 7:10]) * UPWARDS
    assert "body frame" not in table(with_parts(flight, v=pushed))[THRUST].suggestion


def test_time_on_the_ground_is_found_and_not_compared(flight):
    x = np.tile(flight.x[:1], (600, 1))
    x[:, 7:], x[:, 2] = 0, flight.x[:, 2].min() - 0.3
    x[:, :3] += np.random.default_rng(0).normal(0, 1e-5, (600, 3))  # no repeated sample
    t, u = np.arange(600 + len(flight)) * 0.01, np.concatenate([np.full((600, 4), 5.0), flight.u])
    check = table(FlightLog(t, np.concatenate([x, flight.x]), u))
    assert check["time on the ground"].value == pytest.approx(600 / len(t))
    verdicts = [check[name].verdict for name in ("time on the ground", RATIO, VELOCITY, RATES, THRUST)]
    assert verdicts == [FAILS, OK, OK, OK, OK]


def test_the_suggested_shift_repairs_the_lag_also_of_motors_that_are_samples_and_not_means(flight):
    late = with_parts(flight[:-5], u=flight.u[5:])
    assert table(late)[LAG].value == pytest.approx(50, abs=2)
    repaired, _ = delay(late, table(late)[LAG].value / 1000)
    assert table(repaired)[LAG].verdict == OK
    sampled = with_parts(flight[1:], u=(flight.u[1:] + flight.u[:-1]) / 2)
    check = table(noisy(sampled, np.random.default_rng(3)))[LAG]
    assert (check.verdict, "motors are samples, not held" in check.suggestion) == (WARNS, True), check
    assert check.value == pytest.approx(-5, abs=1.5)
    assert table(delay(sampled, check.value / 1000)[0])[LAG].verdict == OK


def test_gaps_and_repeats_hide_no_other_mistake(flight):
    kept = np.ones(len(flight), bool)
    kept[101::50] = False
    x = flight.x.copy()
    x[30::60] = x[29::60][: len(x[30::60])]
    check = table(FlightLog(flight.t, x, flight.u)[kept])
    assert check["gaps"].value == pytest.approx(22 / 1178, rel=0.1)
    assert check["repeated samples"].value == pytest.approx(20 / 1178, rel=0.1)
    verdicts = [check[name].verdict for name in ("gaps", "repeated samples", VELOCITY, RATES, THRUST)]
    assert verdicts == [FAILS, FAILS, OK, OK, OK]


@pytest.mark.parametrize("noise", [False, True])
def test_vehicle_at_rest_decides_nothing(flight, noise):
    """Nor does the noise of its sensors, of which a longer mean leaves nothing."""
    x = np.tile(flight.x[:1], (900, 1))
    x[:, 3:] = [1.0, *np.zeros(9)]
    x[:, 0] += np.random.default_rng(0).normal(size=900) * 1e-4
    log = FlightLog(np.arange(900) * 0.01, x, np.full((900, 4), IRIS.hover_speed))
    found = table(noisy(log, np.random.default_rng(1)) if noise else log)
    assert {found[name].verdict for name in (VELOCITY, RATES, THRUST, ORDER, YAW, LAG)} == {UNKNOWN}
    assert found[RATIO].verdict == OK


@pytest.mark.parametrize("samples", [2, 3, 10, 30])
def test_short_logs_decide_nothing(flight, samples):
    log = flight[:samples]
    wrong = table(with_parts(log, p=log.x[:, [1, 0, 2]], omega=-log.x[:, 10:]))
    assert len(wrong) == 12
    assert all(wrong[name].verdict == UNKNOWN for name in (VELOCITY, RATES, THRUST)) == (samples < 30)


PLANTED = {f"{kind}: {name}": own for kind, kinds in log_mistakes.MISTAKES.items() for name, own in kinds.items()}


@pytest.fixture(scope="module")
def parts(flight):
    noise = log_mistakes.NOISE * np.random.default_rng(0).normal(size=flight.x.shape)
    return log_mistakes.parts_of(FlightLog(flight.t, flight.x + noise, flight.u))


def test_nothing_is_said_of_a_sound_flight(parts):
    assert log_mistakes.said(parts) == []


@pytest.mark.parametrize("mistake", PLANTED)
def test_every_mistake_is_named(parts, mistake):
    make, words = PLANTED[mistake]
    lines = [line for _, line in log_mistakes.said(make(parts))]
    assert any(words in line for line in lines), lines
