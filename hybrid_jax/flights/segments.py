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


def segments(log: FlightLog) -> list[slice]:
    """Maximal runs of at least two samples joined by sound intervals."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], sound_intervals(log), [0]])))
    return [slice(int(start), int(stop) + 1) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


def even_segments(log: FlightLog) -> list[slice]:
    """Return the segments after checking that the samples of each are evenly spaced.

    Raises:
        ValueError: the time of the first uneven interval.
    """
    for part in (found := segments(log)):
        uneven = _uneven(log, part)
        if uneven.any():
            at = log.t[part][int(uneven.argmax())]
            raise ValueError(f"{log.name}: samples at {at:.6g} s are not {log.dt:.6g} s apart; resample the log first")
    return found


def is_even(log: FlightLog) -> bool:
    """Whether the samples of each segment are evenly spaced."""
    return not any(_uneven(log, part).any() for part in segments(log))


def _uneven(log: FlightLog, part: slice) -> Bool[np.ndarray, " n-1"]:
    return np.abs(np.diff(log.t[part]) - log.dt) > JITTER * log.dt


def at_rest(log: FlightLog) -> Bool[np.ndarray, " n"]:
    """Whether a sample belongs to a period of half a second or more with hardly any thrust, on the ground."""
    power = (log.u**2).sum(axis=1)
    idle = power < IDLE * np.quantile(power, 0.9)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], idle, [0]])))
    found = np.zeros(len(log), bool)
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        found[start:stop] = log.t[stop - 1] - log.t[start] >= RESTING
    return found
