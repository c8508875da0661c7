"""Pairs of records that should be equal, for example dp/dt and v, each with one common mistake undone."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from hybrid_jax.flights.attitude import BODIES, WORLDS, quaternion_from_matrix, rates_between, rotation_of
from hybrid_jax.flights.checks.airborne import flying_intervals
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, VELOCITY

NOTHING = "nothing to correct"
LATE = (0.1, 0.2)  # delays and advances that are tried [s]
WORLD = 'velocity is in the world, read as the body\'s: velocity = "world", or for a bag topics={"velocity": "TOPIC"}'
HANDED = "the world is left-handed: "
HEADING = "the heading is counted from another axis than x, off by"
BODY = 'velocity is in the body frame (FLU): set velocity = "body"'
UP = np.array([0.0, 0.0, 1.0])
GRAVITY = 9.81 * UP
FLIPS = dict(zip("xyz", 1 - 2 * np.eye(3), strict=True))

Vectors = Float[np.ndarray, "n 3"]
Pairs = dict[str, tuple[Vectors, Vectors]]


def velocities(log: FlightLog) -> Pairs:
    """Pair dp/dt with v [m/s]."""
    p, v, attitude = log.x[:, POSITION], log.x[:, VELOCITY], rotation_of(log.x[:, QUATERNION])
    slope, frd = np.diff(p, axis=0) / np.diff(log.t)[:, None], BODIES["FRD"]
    stated = {
        NOTHING: v,
        BODY: attitude.apply(v),
        'velocity is in the body frame (FRD): set velocity = "body" and body = "FRD"': attitude.apply(v @ frd),
        WORLD: attitude.inv().apply(v),
        "x and y of velocity or position are exchanged: name their columns the other way round": v[:, [1, 0, 2]],
        'velocity is NED, position is not: convert velocity from world = "NED"': v @ WORLDS["NED"].T,
        "velocity has y and z the other way round than position: flip the signs of vy and vz": v * [1, -1, -1],
        "velocity is in mm/s or position in km: set the units": v * 1e-3,
        "velocity is in cm/s: set its unit": v * 1e-2,
        "velocity is in km/h: set its unit": v / 3.6,
        "position is in feet: set its unit": v / 0.3048,
        "position is in mm: set its unit": v * 1e3,
        "position is in cm: set its unit": v * 1e2,
    } | {f"velocity is about {words}": v[rows] for words, rows in _shifted(log)}
    for axis, signs in FLIPS.items():
        stated[f"v{axis} and p{axis} have opposite signs: flip one"] = v * signs
    return {mistake: (slope, middle(values)) for mistake, values in stated.items()}


def _shifted(log: FlightLog) -> Iterator[tuple[str, np.ndarray]]:
    """Iterate over time shifts, with a description of each and the rows that undo it."""
    now = np.arange(len(log))
    for seconds in LATE:
        late = round(seconds / log.dt)
        yield f"{seconds:g} s late: shift its times by that", np.minimum(now + late, now[-1])
        yield f"{seconds:g} s early: shift its times by that", np.maximum(now - late, 0)


def rates(log: FlightLog) -> Pairs:
    """Pair the body rates between attitudes with ω [rad/s]."""
    q, omega = log.x[:, QUATERNION], middle(log.x[:, BODY_RATES])
    turned, back = rates_between(log.t, q), rotation_of(q[:-1]).inv()
    found = {
        NOTHING: (turned, omega),
        "body rates are in degrees per second: declare deg/s": (turned, omega * np.pi / 180),
        "body rates are in rad/s, declared deg/s: declare rad/s": (turned, omega * 180 / np.pi),
        "body rates are in the world frame: rotate them into the body": (turned, back.apply(omega)),
        "body rates and attitude differ in body frame: convert the one that is FRD": (turned, omega @ BODIES["FRD"]),
        "x and y of the body rates are exchanged: name their columns so": (turned, omega[:, [1, 0, 2]]),
        "body rates have the opposite sign": (turned, -omega),
    }
    for words, rows in _shifted(log):
        found[f"body rates are about {words}"] = turned, middle(log.x[rows, BODY_RATES])
    for mistake, attitude in _attitudes(q).items():
        found[mistake] = rates_between(log.t, attitude), omega
    w, x, y, z = q.T
    mirrored = _turn(-2 * np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), q)
    found["the heading is counted clockwise: flip the sign of yaw"] = rates_between(log.t, mirrored), omega
    for axis, signs in FLIPS.items():
        found[f"w{axis} has the wrong sign: flip it"] = turned, omega * signs
        found[f"q{axis} has the wrong sign: flip it"] = rates_between(log.t, q * [1, *signs]), omega
    return found


def accelerations(log: FlightLog) -> Pairs:
    """Pair v̇ with Σu² along body z minus gravity, at the best thrust coefficient [m/s²]."""
    q, v = log.x[:, QUATERNION], log.x[:, VELOCITY]
    attitude, thrust = rotation_of(q), (log.u[:-1] ** 2).sum(axis=1, keepdims=True)
    frd = attitude.as_matrix() @ BODIES["FRD"].T
    ned = quaternion_from_matrix(WORLDS["NED"] @ frd)
    stated = {
        NOTHING: (q, v),
        'the log is NED and FRD: set world = "NED" and body = "FRD"': (ned, v @ WORLDS["NED"].T),
        "only the attitude is NED and FRD: convert it": (ned, v),
        'only position and velocity are NED: set world = "NED" for them': (q, v @ WORLDS["NED"].T),
        "height is counted downwards: flip the signs of pz and vz": (q, v * [1, 1, -1]),
        'the body is FRD in a world with z up: set body = "FRD"': (quaternion_from_matrix(frd), v),
        BODY: (q, attitude.apply(v)),
    }
    stated[f"{HANDED}flip the signs of py and vy"] = q, v * [1, -1, 1]
    stated[f"{HANDED}exchange x and y of position and velocity"] = q, v[:, [1, 0, 2]]
    for degrees in (90, -90, 180):
        stated[f"{HEADING} {degrees}°: add that to yaw"] = _turn(np.full(len(q), np.deg2rad(degrees)), q), v
    # Other mistakes of attitudes rotate thrust about z only, which wind or a load may do as well.
    stated |= {mistake: (other, v) for mistake, other in list(_attitudes(q).items())[:2]}
    return {mistake: _by_thrust(log, q, v, thrust) for mistake, (q, v) in stated.items()}


def _turn(angle: Float[np.ndarray, " n"], q: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Rotate attitudes about the world's z [rad]."""
    w, x, y, z = q.T
    c, s = np.cos(angle / 2), np.sin(angle / 2)
    return np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=1)


def _attitudes(q: Float[np.ndarray, "n 4"]) -> dict[str, Float[np.ndarray, "n 4"]]:
    last_first, inverse = np.roll(q, 1, axis=1), np.array([1, -1, -1, -1])
    return {
        "the quaternion is (x, y, z, w), read as (w, x, y, z): declare xyzw": last_first,
        "the quaternion is world → body: conjugate it": q * inverse,
        "the quaternion is (w, x, y, z), declared xyzw: declare wxyz": np.roll(q, -1, axis=1),
        "the quaternion is (x, y, z, w) and world → body: declare xyzw and conjugate it": last_first * inverse,
    }


def _by_thrust(log: FlightLog, q, v, thrust) -> tuple[Vectors, Vectors]:
    slope, sound = np.diff(v, axis=0) / np.diff(log.t)[:, None], flying_intervals(log)[:, None]
    predicted = middle(rotation_of(q).apply(UP)) * thrust
    power = (predicted**2 * sound).sum()
    scale = max(0.0, (predicted * (slope + GRAVITY) * sound).sum() / power) if power > 0 else 0.0
    return slope, scale * predicted - GRAVITY


def middle(values: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n-1 d"]:
    """Average adjacent samples."""
    return 0.5 * (values[1:] + values[:-1])


def moving_mean(values: Float[np.ndarray, "n d"], width: int) -> Float[np.ndarray, "m d"]:
    total = np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), values]), axis=0)
    return (total[width:] - total[:-width]) / width


def band_passed(values: Float[np.ndarray, "n d"], fast: int, slow: int) -> Float[np.ndarray, "m d"]:
    """Average each `fast` consecutive rows, without the average of `slow` of these around each."""
    smooth = moving_mean(values, fast)
    trend = moving_mean(smooth, slow)
    return smooth[slow // 2 :][: len(trend)] - trend
