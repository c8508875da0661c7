"""Is a log what it is taken for? Each check holds two independent records of one motion against each other.

Where they disagree, the usual mistakes are undone one at a time, and the one that makes them agree is suggested.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from hybrid_jax.flights.attitude import BODIES, WORLDS, quaternion_of, rates_between, rotation_of
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.motor_response import moving_mean, respond
from hybrid_jax.flights.segments import gaps, repeats, sound_intervals
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from hybrid_jax.vehicle import Vehicle

OK, FAILS, UNKNOWN = "ok", "fails", "cannot tell"
NOTHING = "nothing to correct"
MORE_FLIGHT = "check on a flight with more motion"
SPAN = 0.05  # s of moving average on both sides of an equation
MOST_SAMPLES = 100_000  # of a longer log, its middle

# Relative errors: 0 where two records agree, 1 where they have nothing in common, √2 where they are opposed.
KINEMATICS_LIMIT = 0.5
THRUST_LIMIT = 0.6
THRUST_RATIO_LIMIT = 1.25
ORDER_LIMIT = 0.4  # correlation
LEAST_MOTION = {"velocity": 0.05, "rates": 0.03, "acceleration": 0.2}  # RMS in m/s, rad/s, m/s²

UP = np.array([0.0, 0.0, 1.0])
GRAVITY = 9.81 * UP

Vectors = Float[np.ndarray, "n 3"]
Fits = dict[str, tuple[Vectors, Vectors]]


@dataclass(frozen=True)
class Check:
    """One line of the table.

    Attributes:
        name: what was held against what.
        value, unit, limit: what was measured and what it may be at most (correlations: at least).
        verdict: "ok", "fails" or "cannot tell".
        suggestion: what to correct, or that there is nothing.
    """

    name: str
    value: float
    unit: str
    limit: float
    verdict: str
    suggestion: str


def check_log(log: FlightLog, vehicle: Vehicle) -> list[Check]:
    """Every check that a log and what is known of its vehicle allow.

    Raises:
        ValueError: fewer than two samples.
    """
    skip = max(0, (len(log) - MOST_SAMPLES) // 2)
    log = log[skip : skip + MOST_SAMPLES]
    return [
        *_samples(log),
        _velocity(log),
        _rates(log),
        _thrust_direction(log),
        _thrust_ratio(log, vehicle),
        *_motors(log, vehicle),
    ]


def _samples(log: FlightLog) -> list[Check]:
    lost, stale = float(gaps(log).mean()), float(repeats(log).mean())
    split = "windows and filters stop at each; resample(log, dt, longest_gap) bridges short ones if you ask"
    return [
        Check("gaps", lost, "share of intervals", 0.01, *_at_most(lost, 0.01, split)),
        Check("repeated samples", stale, "share of samples", 0.01, *_at_most(stale, 0.01, split)),
    ]


def _at_most(value: float, limit: float, suggestion: str) -> tuple[str, str]:
    return (OK, NOTHING) if value <= limit else (FAILS, suggestion)


def _velocity(log: FlightLog) -> Check:
    p, v, attitude = log.x[:, POSITION], log.x[:, VELOCITY], rotation_of(log.x[:, QUATERNION])
    slope = np.diff(p, axis=0) / np.diff(log.t)[:, None]
    readings = {
        NOTHING: v,
        'velocity is in the body frame (FLU): set velocity = "body"': attitude.apply(v),
        'velocity is in the body frame (FRD): set velocity = "body" and body = "FRD"': attitude.apply(
            v @ BODIES["FRD"]
        ),
        'velocity is NED, position is not: convert velocity from world = "NED"': v @ WORLDS["NED"].T,
        "velocity is north-west-down against position: flip the sign of vz": v * [1, 1, -1],
        "velocity has y and z the other way round than position: flip the signs of vy and vz": v * [1, -1, -1],
        "velocity is in mm/s or position in km: set the units": v * 1e-3,
        "velocity is in cm/s: set its unit": v * 1e-2,
        "position is in mm: set its unit": v * 1e3,
        "position is in cm: set its unit": v * 1e2,
    }
    fits = {name: (slope, _middle(reading)) for name, reading in readings.items()}
    return _judge(log, "dp/dt against v", fits, KINEMATICS_LIMIT, LEAST_MOTION["velocity"])


def _rates(log: FlightLog) -> Check:
    q, omega = log.x[:, QUATERNION], log.x[:, BODY_RATES]
    turned, stated = rates_between(log.t, q), _middle(omega)
    last_first, inverse = np.roll(q, 1, axis=1), q * [1, -1, -1, -1]
    back = rotation_of(q[:-1]).inv()
    fits = {
        NOTHING: (turned, stated),
        "the quaternion is (x, y, z, w), read as (w, x, y, z): declare xyzw": (
            rates_between(log.t, last_first),
            stated,
        ),
        "the quaternion is world → body: conjugate it": (rates_between(log.t, inverse), stated),
        "the quaternion is (x, y, z, w) and world → body: declare xyzw and conjugate it": (
            rates_between(log.t, last_first * [1, -1, -1, -1]),
            stated,
        ),
        "body rates are in degrees per second: declare deg/s": (turned, stated * np.pi / 180),
        "body rates are in the world frame: rotate them into the body": (turned, back.apply(stated)),
        "body rates and attitude differ in body frame: convert the one that is FRD": (turned, stated @ BODIES["FRD"]),
        "body rates have the opposite sign": (turned, -stated),
    }
    return _judge(log, "q̇ against ω", fits, KINEMATICS_LIMIT, LEAST_MOTION["rates"])


def _thrust_direction(log: FlightLog) -> Check:
    """v̇ + g against Σu² along body z, whatever the thrust coefficient."""
    q, v = log.x[:, QUATERNION], log.x[:, VELOCITY]
    attitude, thrust = rotation_of(q), (log.u[:-1] ** 2).sum(axis=1, keepdims=True)
    ned = quaternion_of(_turned(attitude, WORLDS["NED"], BODIES["FRD"]))
    readings = {
        NOTHING: (q, v),
        'the log is NED and FRD: set world = "NED" and body = "FRD"': (ned, v @ WORLDS["NED"].T),
        "attitude alone is NED and FRD: convert it": (ned, v),
        'position and velocity alone are NED: set world = "NED" for them': (q, v @ WORLDS["NED"].T),
        'the body is FRD in a world with z up: set body = "FRD"': (
            quaternion_of(_turned(attitude, np.eye(3), BODIES["FRD"])),
            v,
        ),
        "the quaternion is (x, y, z, w), read as (w, x, y, z): declare xyzw": (np.roll(q, 1, axis=1), v),
        "the quaternion is world → body: conjugate it": (q * [1, -1, -1, -1], v),
        'velocity is in the body frame: set velocity = "body"': (q, attitude.apply(v)),
    }
    fits = {name: _accelerations(log, q, v, thrust) for name, (q, v) in readings.items()}
    return _judge(log, "v̇ against thrust along body z", fits, THRUST_LIMIT, LEAST_MOTION["acceleration"])


def _turned(attitude: Rotation, world, body) -> Rotation:
    return Rotation.from_matrix(world @ attitude.as_matrix() @ body.T)


def _accelerations(log: FlightLog, q, v, thrust) -> tuple[Vectors, Vectors]:
    """v̇ as the velocity has it, and as Σu² along body z less gravity has it, at the best thrust coefficient."""
    up, slope = _middle(rotation_of(q).apply(UP)), np.diff(v, axis=0) / np.diff(log.t)[:, None]
    specific, sound = slope + GRAVITY, sound_intervals(log)[:, None]
    predicted = up * thrust
    power = (predicted**2 * sound).sum()
    scale = max(0.0, (predicted * specific * sound).sum() / power) if power > 0 else 0.0
    return slope, scale * predicted - GRAVITY


def _thrust_ratio(log: FlightLog, vehicle: Vehicle) -> Check:
    """Mean specific force along body z over k Σu² / m."""
    name, sound = "specific force over thrust per mass", sound_intervals(log)
    thrust = vehicle.thrust_coefficient / vehicle.mass * (log.u[:-1] ** 2).sum(axis=1)[sound]
    specific = np.diff(log.x[:, VELOCITY], axis=0) / np.diff(log.t)[:, None] + [0, 0, vehicle.gravity]
    along = (specific * _middle(rotation_of(log.x[:, QUATERNION]).apply(UP))).sum(axis=1)[sound]
    if not len(thrust) or thrust.mean() <= 0:
        return Check(
            name, float("nan"), "ratio", THRUST_RATIO_LIMIT, UNKNOWN, "the motors stand still: check in flight"
        )
    ratio = float(along.mean() / thrust.mean())
    if 1 / THRUST_RATIO_LIMIT <= ratio <= THRUST_RATIO_LIMIT:
        return Check(name, ratio, "ratio", THRUST_RATIO_LIMIT, OK, NOTHING)
    return Check(name, ratio, "ratio", THRUST_RATIO_LIMIT, FAILS, _thrust_suggestion(ratio, log, vehicle))


def _thrust_suggestion(ratio: float, log: FlightLog, vehicle: Vehicle) -> str:
    if ratio <= 0:
        return "body z points down: correct the frames first"
    for unit, factor in (("rpm", np.pi / 30), ("rev/s", 2 * np.pi), ("deg/s", np.pi / 180)):
        if 0.7 < ratio / factor**2 < 1.4:
            return f"rotor speeds are in {unit}: declare it"
    if log.u.max() < 0.02 * vehicle.hover_speed:
        return "rotor speeds are normalised commands: give the polynomial that maps them to rad/s"
    return f"multiply thrust_coefficient by {ratio:.3g}, or divide mass by it, whichever is less sure"


def _motors(log: FlightLog, vehicle: Vehicle) -> list[Check]:
    found, limit = respond(log, vehicle), 1000 * log.dt
    if found is None or sum(found.correlations[:2]) < 2 * ORDER_LIMIT:
        value = float("nan") if found is None else min(found.correlations[:2])
        return [
            Check("motor order against roll and pitch", value, "correlation", ORDER_LIMIT, UNKNOWN, MORE_FLIGHT),
            Check("spin against yaw", float("nan"), "correlation", 0.0, UNKNOWN, MORE_FLIGHT),
            Check("lag of the gyro behind the motors", float("nan"), "ms", limit, UNKNOWN, MORE_FLIGHT),
        ]
    right = found.order == (0, 1, 2, 3)
    columns = " ".join(f"u{motor}" for motor in found.order)
    order = (OK, NOTHING) if right else (FAILS, f"reorder the motors: the vehicle's rotors 0 1 2 3 are {columns}")
    return [
        Check("motor order against roll and pitch", min(found.as_is[:2]), "correlation", ORDER_LIMIT, *order),
        _spin(found.yaw_sign * found.correlations[2]),
        _lag(1000 * found.lag, limit),
    ]


def _spin(yaw: float) -> Check:
    if abs(yaw) < 0.1:
        verdict = UNKNOWN, MORE_FLIGHT
    else:
        verdict = (OK, NOTHING) if yaw > 0 else (FAILS, "flip the sign of every spin of the vehicle")
    return Check("spin against yaw", yaw, "correlation", 0.1, *verdict)


def _lag(lag: float, limit: float) -> Check:
    way = "later" if lag > 0 else "earlier"
    advice = f"shift the motors {abs(lag):.1f} ms {way}: delay_motors(log, {lag / 1000:.4f})"
    if lag > 0:
        advice += ", or lag_motors if they are commands"
    return Check("lag of the gyro behind the motors", lag, "ms", limit, *_at_most(abs(lag), limit, advice))


def _middle(values: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n-1 d"]:
    return 0.5 * (values[1:] + values[:-1])


def _judge(log: FlightLog, name: str, fits: Fits, limit: float, least: float) -> Check:
    """Compare two records under every reading; the first is the log as it is."""
    smooth = _smoother(log)
    errors = {reading: _relative_error(smooth(a), smooth(b), least) for reading, (a, b) in fits.items()}
    as_is, best = errors[NOTHING], min(errors, key=lambda reading: errors[reading])
    if not np.isfinite(as_is):
        return Check(name, as_is, "relative error", limit, UNKNOWN, MORE_FLIGHT)
    if as_is <= limit and as_is <= max(0.1, 2 * errors[best]):
        return Check(name, as_is, "relative error", limit, OK, NOTHING)
    known = errors[best] <= min(limit, 0.7 * as_is)
    advice = best if known else "no usual mistake explains it: look at sensors, time stamps and columns"
    return Check(name, as_is, "relative error", limit, FAILS, advice)


def _smoother(log: FlightLog) -> Callable[[Vectors], Vectors]:
    """Means over `SPAN` of sound intervals only."""
    sound = sound_intervals(log)[:, None].astype(float)
    width = min(max(1, round(SPAN / log.dt)), len(sound))
    whole = moving_mean(sound, width)[:, 0] > 1 - 1e-9
    return lambda values: moving_mean(values, width)[whole]


def _relative_error(a: Vectors, b: Vectors, least: float) -> float:
    """RMS of a − b over the root of the summed mean squares; NaN where both are below the least motion."""
    if not len(a):
        return float("nan")
    size = (a**2).sum(axis=1).mean(), (b**2).sum(axis=1).mean()
    if max(size) < least**2:
        return float("nan")
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean() / sum(size)))
