"""Estimate the order, spin and lag of motors by correlating the body's rotation with them."""

from functools import cache
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from hybrid_jax.flights.checks.mistakes import band_passed, middle, moving_mean
from hybrid_jax.flights.log import FlightLog, sound_intervals
from hybrid_jax.vehicle import BODY_RATES, Vehicle

LONGEST_LAG, SHORT_LAG = 0.25, 0.1  # s, either way; the second for short logs
# Moving means of torque and motors: the short one removes noise. Subtracting the long one removes aerodynamic moments
# and offsets of the centre of mass, which motors counteract and would appear to cause.
FAST, SLOW = 0.03, 0.2  # s
YAW_LEAD = 0.02  # s by which yaw may precede or follow roll and pitch
# With more than four motors, several orders explain roll and pitch, because the pilot commands only four numbers. The
# recorded order is kept if it is one of them.
AMBIGUOUS = 0.1  # of the sum of two correlations
PERMUTED = 6  # rotors up to which all orders are tried (720); with more, only exchanges of two


class Response(NamedTuple):
    """The motor order and lag that explain roll and pitch best, and the correlation with yaw."""

    order: tuple[int, ...]  # u[:, order] is in the order of the vehicle's rotors
    yaw_sign: int  # −1 if every rotor spins opposite to the vehicle file
    lag: float  # time by which angular acceleration follows the motors [s]; negative if it precedes them
    correlations: list[float]  # of roll and pitch at that order and lag, of yaw (its size) at its best lag near it
    change: float  # of the torque about roll and pitch from one sample to the next, as a share of its size
    as_is: list[float]  # of roll, pitch and yaw for the motors in their present order, at that lag


def respond(log: FlightLog, vehicle: Vehicle) -> Response | None:
    """Find the best order and lag up to ±0.1 s, then the sign of yaw; None with too little flight."""
    torque, squares = _quick(log, vehicle)
    reach = round(min(LONGEST_LAG, max(SHORT_LAG, len(squares) * log.dt / 8)) / log.dt)
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
    left, top, right = score[[max(at - 1, 0), at, min(at + 1, 2 * reach)], best]
    inside, curve = 0 < at < 2 * reach, left - 2 * top + right
    vertex = 0.5 * (left - right) / curve if inside and curve < 0 else 0.0  # of a parabola through the peak
    lag = (at - reach + vertex) * log.dt
    order = orders(len(arms))[best]
    turning = squares @ mix[:2, np.argsort(order)].T
    change = float(np.sqrt((np.diff(turning, axis=0) ** 2).mean() / (turning**2).mean()))
    return Response(tuple(order.tolist()), sign, float(lag), found, change, table[at, 0].tolist())


@cache
def orders(rotors: int) -> Int[np.ndarray, "orders rotors"]:
    """List the candidate motor orders, beginning with the recorded one."""
    if rotors <= PERMUTED:
        return np.array(list(permutations(range(rotors))))
    found = np.tile(np.arange(rotors), (1 + rotors * (rotors - 1) // 2, 1))
    for row, (i, j) in zip(found[1:], combinations(range(rotors), 2), strict=True):
        row[[i, j]] = j, i
    return found


def correlations(
    torque: Float[np.ndarray, "n 3"], squares: Float[np.ndarray, "n rotors"], mix: Float[np.ndarray, "3 rotors"], lag
) -> Float[np.ndarray, "orders 3"]:
    """Correlate torque with the prediction of each motor order, `lag` samples earlier."""
    ahead, behind = (torque[lag:], squares[: len(squares) - lag]) if lag >= 0 else (torque[:lag], squares[-lag:])
    cross, spread = ahead.T @ behind, behind.T @ behind
    order = orders(mix.shape[1])
    shared = np.einsum("aj,aoj->oa", mix, cross[:, order])
    variance = np.einsum("ai,oij,aj->oa", mix, spread[order[:, :, None], order[:, None, :]], mix)
    least = 1e-9 * variance.max(axis=0)  # some orders of six rotors predict nothing
    return np.where(variance > least, shared / np.sqrt(np.maximum(variance * (ahead**2).sum(axis=0), 1e-300)), 0.0)


def _quick(log: FlightLog, vehicle: Vehicle) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n rotors"]]:
    """Return J ω̇ + ω × J ω and u², band-passed from `FAST` to `SLOW`; zero near gaps."""
    fast, slow = (max(1, round(span / log.dt)) for span in (FAST, SLOW))
    sound, omega, inertia = sound_intervals(log), log.x[:, BODY_RATES], np.asarray(vehicle.inertia)
    if len(sound) < fast + slow:
        return np.zeros((0, 3)), np.zeros((0, log.u.shape[1]))
    mean = middle(omega)
    torque = inertia * np.diff(omega, axis=0) / np.diff(log.t)[:, None] + np.cross(mean, inertia * mean)
    whole = moving_mean(sound[:, None].astype(float), fast + slow - 1) > 1 - 1e-9
    quick = (np.where(whole, band_passed(each, fast, slow), 0.0) for each in (torque, log.u[:-1] ** 2))
    return next(quick), next(quick)
