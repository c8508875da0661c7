"""Readings of a log: pairs of records that should be equal, such as dp/dt and v, each after undoing one mistake.

From angular acceleration and motors `respond` estimates the order of the motors, their direction of spin and their lag.
"""

from functools import cache
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from hybrid_jax.flights.attitude import BODIES, WORLDS, quaternion_from_matrix, rates_between, rotation_of
from hybrid_jax.flights.checks.airborne import flying_intervals
from hybrid_jax.flights.log import FlightLog, sound_intervals
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from hybrid_jax.vehicle import Vehicle

NOTHING = "nothing to correct"  # the reading of the unchanged log
LATE = 0.1  # delay or advance of a velocity that is tried [s]
UP = np.array([0.0, 0.0, 1.0])
GRAVITY = 9.81 * UP
FLIPS = dict(zip("xyz", 1 - 2 * np.eye(3), strict=True))

LONGEST_LAG = 0.1  # s, either way
# Moving means of torque and motors: the short one removes noise. Subtracting the long one removes aerodynamic moments
# and offsets of the centre of mass, which motors counteract and would appear to cause.
FAST, SLOW = 0.03, 0.2  # s
YAW_LEAD = 0.02  # s by which yaw may precede or follow roll and pitch
# Of more than four motors the pilot mixes four numbers: several orders explain roll and pitch. One that does is kept.
AMBIGUOUS = 0.1  # of the sum of two correlations
PERMUTED = 6  # rotors at most of which all orders are tried: 720; of more, those with two exchanged

Vectors = Float[np.ndarray, "n 3"]
Readings = dict[str, tuple[Vectors, Vectors]]


def velocities(log: FlightLog) -> Readings:
    """dp/dt and v [m/s]."""
    p, v, attitude = log.x[:, POSITION], log.x[:, VELOCITY], rotation_of(log.x[:, QUATERNION])
    slope, frd = np.diff(p, axis=0) / np.diff(log.t)[:, None], BODIES["FRD"]
    now, late = np.arange(len(v)), round(LATE / log.dt)
    stated = {
        NOTHING: v,
        'velocity is in the body frame (FLU): set velocity = "body"': attitude.apply(v),
        'velocity is in the body frame (FRD): set velocity = "body" and body = "FRD"': attitude.apply(v @ frd),
        "x and y of velocity or position are exchanged: name their columns the other way round": v[:, [1, 0, 2]],
        'velocity is NED, position is not: convert velocity from world = "NED"': v @ WORLDS["NED"].T,
        "velocity has y and z the other way round than position: flip the signs of vy and vz": v * [1, -1, -1],
        "velocity is in mm/s or position in km: set the units": v * 1e-3,
        "velocity is in cm/s: set its unit": v * 1e-2,
        "position is in mm: set its unit": v * 1e3,
        "position is in cm: set its unit": v * 1e2,
        f"velocity is about {LATE:g} s late: shift it": v[np.minimum(now + late, now[-1])],
        f"velocity is about {LATE:g} s early: shift it": v[np.maximum(now - late, 0)],
    }
    for axis, signs in FLIPS.items():
        stated[f"v{axis} and p{axis} have opposite signs: flip one"] = v * signs
    return {reading: (slope, middle(values)) for reading, values in stated.items()}


def rates(log: FlightLog) -> Readings:
    """Body rates that turn each attitude into the next, and ω [rad/s]."""
    q, omega = log.x[:, QUATERNION], middle(log.x[:, BODY_RATES])
    turned, back = rates_between(log.t, q), rotation_of(q[:-1]).inv()
    found = {
        NOTHING: (turned, omega),
        "body rates are in degrees per second: declare deg/s": (turned, omega * np.pi / 180),
        "body rates are in rad/s, declared deg/s: declare rad/s": (turned, omega * 180 / np.pi),
        "body rates are in the world frame: rotate them into the body": (turned, back.apply(omega)),
        "body rates and attitude differ in body frame: convert the one that is FRD": (turned, omega @ BODIES["FRD"]),
        "body rates have the opposite sign": (turned, -omega),
    }
    for reading, attitude in _attitudes(q).items():
        found[reading] = rates_between(log.t, attitude), omega
    for axis, signs in FLIPS.items():
        found[f"w{axis} has the wrong sign: flip it"] = turned, omega * signs
        found[f"q{axis} has the wrong sign: flip it"] = rates_between(log.t, q * [1, *signs]), omega
    return found


def accelerations(log: FlightLog) -> Readings:
    """v̇, and Σu² along body z less gravity at the best thrust coefficient [m/s²]."""
    q, v = log.x[:, QUATERNION], log.x[:, VELOCITY]
    attitude, thrust = rotation_of(q), (log.u[:-1] ** 2).sum(axis=1, keepdims=True)
    frd = attitude.as_matrix() @ BODIES["FRD"].T
    ned = quaternion_from_matrix(WORLDS["NED"] @ frd)
    stated = {
        NOTHING: (q, v),
        'the log is NED and FRD: set world = "NED" and body = "FRD"': (ned, v @ WORLDS["NED"].T),
        "attitude alone is NED and FRD: convert it": (ned, v),
        'position and velocity alone are NED: set world = "NED" for them': (q, v @ WORLDS["NED"].T),
        "height is counted downwards: flip the signs of pz and vz": (q, v * [1, 1, -1]),
        'the body is FRD in a world with z up: set body = "FRD"': (quaternion_from_matrix(frd), v),
        'velocity is in the body frame: set velocity = "body"': (q, attitude.apply(v)),
    }
    # Other readings of attitudes rotate thrust about z only, which wind or a load may do as well.
    stated |= {reading: (other, v) for reading, other in list(_attitudes(q).items())[:2]}
    return {reading: _by_thrust(log, q, v, thrust) for reading, (q, v) in stated.items()}


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
    """Means of adjacent samples."""
    return 0.5 * (values[1:] + values[:-1])


class Response(NamedTuple):
    """The order of motors and the lag that explain roll and pitch best, and their correlation with yaw."""

    order: tuple[int, ...]  # u[:, order] is in the order of the vehicle's rotors
    yaw_sign: int  # −1 if every rotor spins opposite to the vehicle file
    lag: float  # time by which angular acceleration follows the motors [s]; negative if it precedes them
    correlations: list[float]  # of roll and pitch at that order and lag, of yaw (its size) at its best lag near it
    as_is: list[float]  # of roll, pitch and yaw for the motors in their present order, at that lag


def respond(log: FlightLog, vehicle: Vehicle) -> Response | None:
    """Find the best order and lag up to ±0.1 s by correlation, then the sign of yaw; None with too little flight."""
    reach = round(LONGEST_LAG / log.dt)
    torque, squares = _quick(log, vehicle)
    if np.count_nonzero(squares.any(axis=1)) < 4 * reach + 8 or not (torque.std(axis=0) > 0).all():
        return None
    arms = np.asarray(vehicle.rotor_positions)
    # Roll, pitch and yaw torque per u² of each rotor, up to a positive factor per row.
    mix = np.stack([arms[:, 1], -arms[:, 0], np.asarray(vehicle.spin)])
    table = np.stack([correlations(torque, squares, mix, lag) for lag in range(-reach, reach + 1)])
    # Yaw does not count: an accelerating rotor turns the body at once, so yaw precedes the motors.
    score = table[..., 0] + table[..., 1]
    if len(arms) > 4 and score[:, 0].max() > score.max() - AMBIGUOUS:
        score = score[:, :1]
    at, best = np.unravel_index(score.argmax(), score.shape)
    near = round(YAW_LEAD / log.dt)
    around = table[max(0, at - near) : at + near + 1, best, 2]
    yaw = around[np.abs(around).argmax()]
    sign = -1 if yaw < 0 else 1
    found = [*table[at, best, :2].tolist(), float(abs(yaw))]
    lag = (at - reach + _vertex(score[:, best], int(at))) * log.dt
    return Response(tuple(orders(len(arms))[best].tolist()), sign, float(lag), found, table[at, 0].tolist())


@cache
def orders(rotors: int) -> Int[np.ndarray, "orders rotors"]:
    """The orders of the motors that are tried, first the one that they have."""
    if rotors <= PERMUTED:
        return np.array(list(permutations(range(rotors))))
    found = np.tile(np.arange(rotors), (1 + rotors * (rotors - 1) // 2, 1))
    for row, (i, j) in zip(found[1:], combinations(range(rotors), 2), strict=True):
        row[[i, j]] = j, i
    return found


def correlations(
    torque: Float[np.ndarray, "n 3"], squares: Float[np.ndarray, "n rotors"], mix: Float[np.ndarray, "3 rotors"], lag
) -> Float[np.ndarray, "orders 3"]:
    """Correlation of torque with the prediction of each order of the motors `lag` samples before."""
    ahead, behind = (torque[lag:], squares[: len(squares) - lag]) if lag >= 0 else (torque[:lag], squares[-lag:])
    cross, spread = ahead.T @ behind, behind.T @ behind
    order = orders(mix.shape[1])
    shared = np.einsum("aj,aoj->oa", mix, cross[:, order])
    variance = np.einsum("ai,oij,aj->oa", mix, spread[order[:, :, None], order[:, None, :]], mix)
    least = 1e-9 * variance.max(axis=0)  # some orders of six rotors predict nothing
    return np.where(variance > least, shared / np.sqrt(np.maximum(variance * (ahead**2).sum(axis=0), 1e-300)), 0.0)


def _quick(log: FlightLog, vehicle: Vehicle) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n rotors"]]:
    """J ω̇ + ω × J ω and u² of each interval, band-passed from `FAST` to `SLOW`; zero near gaps."""
    fast, slow = (max(1, round(span / log.dt)) for span in (FAST, SLOW))
    sound, omega, inertia = sound_intervals(log), log.x[:, BODY_RATES], np.asarray(vehicle.inertia)
    if len(sound) < fast + slow:
        return np.zeros((0, 3)), np.zeros((0, log.u.shape[1]))
    mean = middle(omega)
    torque = inertia * np.diff(omega, axis=0) / np.diff(log.t)[:, None] + np.cross(mean, inertia * mean)
    bands = []
    for values in (torque, log.u[:-1] ** 2):
        smooth = moving_mean(values, fast)
        trend = moving_mean(smooth, slow)
        bands.append(smooth[slow // 2 :][: len(trend)] - trend)
    whole = moving_mean(sound[:, None].astype(float), fast + slow - 1) > 1 - 1e-9
    return np.where(whole, bands[0], 0.0), np.where(whole, bands[1], 0.0)


def moving_mean(values: Float[np.ndarray, "n d"], width: int) -> Float[np.ndarray, "m d"]:
    """The mean of each `width` consecutive rows."""
    total = np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), values]), axis=0)
    return (total[width:] - total[:-width]) / width


def _vertex(score: Float[np.ndarray, " l"], at: int) -> float:
    """Sub-sample position of the peak, −0.5 … 0.5, by a parabola through the maximum and its neighbours."""
    if not 0 < at < len(score) - 1:
        return 0.0
    left, top, right = score[at - 1 : at + 2]
    curve = left - 2 * top + right
    return float(0.5 * (left - right) / curve) if curve < 0 else 0.0
