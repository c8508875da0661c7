"""Changes to a log; each returns the new log and one line that describes the change."""

from dataclasses import dataclass

import numpy as np
import scipy  # not scipy.signal, which takes a second: it is imported where it is first used

from hybrid_jax import checks
from hybrid_jax.flights.attitude import interpolate, interpolate_attitude, mean_of_held
from hybrid_jax.flights.checks.airborne import on_ground
from hybrid_jax.flights.log import GAP, FlightLog, even_segments, repeats, runs_of, segments
from hybrid_jax.vehicle import QUATERNION

TIME_CONSTANTS = (0.0, *np.geomspace(0.005, 0.2, 24).tolist())  # s


@dataclass(frozen=True)
class Cleaning:
    """The changes to make to each log, in this order; by default none.

    Attributes:
        in_flight: cut out time on the ground, where the motors idle for at least half a second.
        resample: new interval between samples [s]: states are interpolated, motors averaged.
        longest_gap: with resample, interpolate across gaps and repeated samples up to this long [s].
        delay: delay [s] to add to the motors: the gyro's lag that `check_log` reports.

    Raises:
        ValueError: if a number is out of range, or longest_gap is given without resample.
    """

    in_flight: bool = False
    resample: float | None = None
    longest_gap: float = 0.0
    delay: float = 0.0

    def __post_init__(self):
        if self.resample is not None:
            checks.positive("resample", self.resample)
        checks.not_negative("longest_gap", self.longest_gap)
        checks.number("delay", self.delay)
        if self.longest_gap and self.resample is None:
            raise ValueError("longest_gap bridges gaps only with resample; give both")


def clean(log: FlightLog, cleaning: Cleaning) -> tuple[FlightLog, list[str]]:
    """Apply changes to a log; ValueError if one is impossible. The second result describes each of them in one line.

    Args:
        log: the log to change.
        cleaning: the changes to make.
    """
    resampling = cleaning.resample or log.dt, cleaning.longest_gap
    changes = ("in_flight", in_flight, ()), ("resample", resample, resampling), ("delay", delay, (cleaning.delay,))
    done: list[str] = []
    for name, change, numbers in changes:
        if getattr(cleaning, name):
            try:
                log, line = change(log, *numbers)
            except ValueError as error:
                raise ValueError(f"{log.name}: {name}: {error}") from error
            done.append(line)
    return log, done


def resample(log: FlightLog, dt: float, longest_gap: float = 0.0) -> tuple[FlightLog, str]:
    """Resample each segment at multiples of dt [s]: states linearly, attitudes spherically, motors as means."""
    fresh, parts = log[~repeats(log)], []
    for part in runs_of(np.diff(fresh.t) <= max(1.5 * log.dt, longest_gap), 1):
        piece = fresh[part]
        # The tolerance keeps the last sample despite rounded times.
        first, last = np.ceil(piece.t[0] / dt - 1e-6), np.floor(piece.t[-1] / dt + 1e-6)
        if last > first:
            t = np.clip(dt * np.arange(first, last + 1), piece.t[0], piece.t[-1])
            x = interpolate(t, piece.t, piece.x)
            x[:, QUATERNION] = interpolate_attitude(t, piece.t, piece.x[:, QUATERNION])
            parts.append((t, x, mean_of_held(t, piece.t, piece.u)))
    if not parts:
        raise ValueError(f"no segment without gaps is as long as dt = {dt} s; use a smaller dt or a longest_gap")
    # Drop last samples of a segment that would make the gap after it too short to be detected.
    ends = [following[0][0] - GAP * dt for following in parts[1:]] + [np.inf]
    parts = [[each[part[0] < end] for each in part] for part, end in zip(parts, ends, strict=True)]
    t, x, u = map(np.concatenate, zip(*parts, strict=True))
    done = f"resampled {len(log)} samples to {len(t)} at {dt} s in {sum(len(part[0]) > 0 for part in parts)} segments"
    return FlightLog(t, x, u, log.name), f"{done}, bridging gaps up to {longest_gap} s"


def in_flight(log: FlightLog) -> tuple[FlightLog, str]:
    """Cut out the time on the ground (see `airborne`)."""
    flying = ~on_ground(log)
    if not flying.any():
        raise ValueError("the vehicle stays on the ground; leave the file out")
    return log[flying], f"{len(log) - flying.sum()} samples on the ground cut out"


def delay(log: FlightLog, lag: float) -> tuple[FlightLog, str]:
    """Shift the motors to later times by `lag` [s]; samples that would need unknown values are cut."""
    parts = []
    for piece in (log[part] for part in segments(log)):
        end = piece.t[-1] + log.dt  # the last value is held for one interval
        inside = (piece.t - lag >= piece.t[0] - 1e-9) & (piece.t + log.dt - lag <= end + 1e-9)
        if inside.sum() > 1:
            at = np.append(piece.t[inside], piece.t[inside][-1] + log.dt) - lag
            parts.append((piece.t[inside], piece.x[inside], mean_of_held(at, piece.t, piece.u)[:-1]))
    if not parts:
        raise ValueError(f"no segment without gaps is longer than the lag of {lag} s; leave the file out")
    t, x, u = map(np.concatenate, zip(*parts, strict=True))
    return FlightLog(t, x, u, log.name), f"motors shifted by {1000 * lag:.1f} ms, {len(log) - len(t)} samples cut"


def lag_motors(log: FlightLog, time_constant: float) -> FlightLog:
    """Replace motors u by the mean over each interval of w, with τ ẇ = u − w; segments start in equilibrium."""
    if not time_constant:
        return log
    u, step = log.u.copy(), log.dt / time_constant
    kept = np.exp(-step)
    for part in even_segments(log):
        held = log.u[part]
        speed, _ = scipy.signal.lfilter([0.0, 1 - kept], [1.0, -kept], held, axis=0, zi=held[:1])
        u[part] = held + (speed - held) * (1 - kept) / step
    return FlightLog(log.t, log.x, u, log.name)
