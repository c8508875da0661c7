"""Segments of a log without gaps and without repeated samples."""

import numpy as np
from jaxtyping import Bool

from hybrid_jax.flights.log import FlightLog

GAP = 1.5  # intervals longer than this many times the median are gaps
IDLE = 0.3  # share of the thrust in flight below which a vehicle is on the ground
JITTER = 0.1  # relative deviation from the median interval that still counts as evenly spaced
RESTING = 0.5  # minimum time [s] with idle motors to count as on the ground


def gaps(log: FlightLog) -> Bool[np.ndarray, " n-1"]:
    """Whether samples are missing in an interval."""
    return np.diff(log.t) > GAP * log.dt if len(log) > 1 else np.zeros(0, bool)


def repeats(log: FlightLog) -> Bool[np.ndarray, " n"]:
    """Whether a state equals the one before in every digit, which noise rules out for fresh samples."""
    return np.concatenate([[False], (np.diff(log.x, axis=0) == 0).all(axis=1)])


def sound_intervals(log: FlightLog) -> Bool[np.ndarray, " n-1"]:
    """Whether an interval is no gap and has fresh samples at both ends."""
    stale = repeats(log)
    return ~(gaps(log) | stale[:-1] | stale[1:])


def runs_of(mask: Bool[np.ndarray, " n"], extra: int = 0) -> list[slice]:
    """The maximal runs of true entries, each longer by `extra` at its end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]]))).tolist()
    return [slice(start, stop + extra) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


def segments(log: FlightLog) -> list[slice]:
    """Maximal runs of at least two samples joined by sound intervals."""
    return runs_of(sound_intervals(log), 1)


def even_segments(log: FlightLog) -> list[slice]:
    """Return the segments; refuse a log whose samples are not evenly spaced within each."""
    uneven = unevenness(log)
    if uneven.any():
        at = log.t[int(uneven.argmax())]
        raise ValueError(f"{log.name}: samples at {at:.6g} s are not {log.dt:.6g} s apart; resample the log first")
    return segments(log)


def unevenness(log: FlightLog) -> Bool[np.ndarray, " n-1"]:
    """Whether a sound interval has another length than the median one."""
    return sound_intervals(log) & (np.abs(np.diff(log.t) - log.dt) > JITTER * log.dt)


def at_rest(log: FlightLog) -> Bool[np.ndarray, " n"]:
    """Whether a sample belongs to a period of half a second or more with hardly any thrust, on the ground."""
    power = (log.u**2).sum(axis=1)
    found = np.zeros(len(log), bool)
    for part in runs_of(power < IDLE * np.quantile(power, 0.9)):
        found[part] = log.t[part][-1] - log.t[part.start] >= RESTING
    return found
