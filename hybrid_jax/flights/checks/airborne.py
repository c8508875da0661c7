"""Detect when a vehicle is in the air. On the ground, and near it, accelerations do not show the thrust."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float

from hybrid_jax.flights.log import FlightLog, runs_of, sound_intervals
from hybrid_jax.flights.recording import Recording

IDLE = 0.3  # share of the power in flight below which motors idle
RESTING = 0.5  # s of idle motors that end a flight
CLEAR = 0.2  # m above where the vehicle stood before its motors turned
MARGIN = 0.5  # s left out before and after idle motors if the height is unknown


def airborne(recording: Recording, signal: str = "command") -> list[tuple[float, float]]:
    """Find the start and end [s] of each time in the air, from commands or rotor speeds.

    Motors that idle for half a second end a flight. After such a rest, a flight begins once the vehicle is `CLEAR`
    above the height at which it stood or, without a height, once `MARGIN` has passed and the power has reached its
    median.
    """
    inputs, position = recording.signals[signal], recording.signals.get("position")
    power = (np.asarray(inputs.values) ** 2).sum(axis=1)
    if position is None or "z" not in position.axes:
        return _flights(inputs.t, power)
    z = np.asarray(position.values)[:, position.axes.index("z")]
    return _flights(inputs.t, power, np.interp(inputs.t, position.t, z))


def on_ground(log: FlightLog) -> Bool[np.ndarray, " n"]:
    flights = _flights(log.t, (log.u**2).sum(axis=1), log.x[:, 2])
    return ~within(log.t, flights)


def within(t: Float[np.ndarray, " n"], spans: Iterable[tuple[float, float]]) -> Bool[np.ndarray, " n"]:
    """Whether each time lies in one of the spans, from start to end [s]."""
    return np.any([(t >= start) & (t <= end) for start, end in spans] or [np.zeros(len(t), bool)], axis=0)


def flying_intervals(log: FlightLog) -> Bool[np.ndarray, " n-1"]:
    """Whether each interval is sound and begins in the air."""
    return sound_intervals(log) & ~on_ground(log)[:-1]


def _flights(t, power: Float[np.ndarray, " n"], z=None) -> list[tuple[float, float]]:
    idle = np.zeros(len(power), bool)
    for part in runs_of(power < IDLE * np.quantile(power, 0.9)):
        idle[part] = t[part][-1] - t[part][0] >= RESTING
    found = []
    for run in runs_of(~idle):
        rested, rests, time = run.start > 0, run.stop < len(power), t[run]
        if z is not None and rested:
            clear = runs_of(z[run] > z[run.start - 1] + CLEAR)
            found += [(float(time[part][0]), float(time[part][-1])) for part in clear]
            continue
        carries = time[np.argmax(power[run] >= np.median(power[run]))]
        begin = max(time[0] + MARGIN, carries) if rested else time[0]
        end = time[-1] - MARGIN * rests
        found += [(float(begin), float(end))] if end > begin else []
    return found
