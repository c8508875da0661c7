"""Changes to a log; each returns the new log and one line that describes the change."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # not scipy.signal, which takes a second: it is imported where it is first used

from hybrid_jax import checks
from hybrid_jax.flights.attitude import interpolate, interpolate_attitude, mean_of_held
from hybrid_jax.flights.checks.airborne import on_ground
from hybrid_jax.flights.checks.motor_response import respond
from hybrid_jax.flights.log import GAP, FlightLog, even_segments, repeats, runs_of, segments
from hybrid_jax.state import QUATERNION, STATE_SIZE
from hybrid_jax.vehicle import Vehicle

TIME_CONSTANTS = (0.0, *np.geomspace(0.005, 0.2, 24).tolist())  # s


@dataclass(frozen=True)
class Cleaning:
    """Changes to every log, in this order; by default none.

    Attributes:
        in_flight: cut out periods of half a second and more with hardly any thrust: the vehicle is on the ground.
        resample: new interval between samples [s].
        longest_gap: with resample, interpolate across gaps and repeated samples up to this long [s].
        low_pass: cut-off frequency [Hz] of a zero-phase low-pass filter of states and motors.
        align: shift the motors of each log by their lag to the gyro, found by cross-correlation.
        delay: instead of align, delay of the motors [s].

    Raises:
        ValueError: a number out of its range, or arguments that exclude each other.
    """

    in_flight: bool = False
    resample: float | None = None
    longest_gap: float = 0.0
    low_pass: float | None = None
    align: bool = False
    delay: float = 0.0

    def __post_init__(self):
        for name in ("resample", "low_pass"):
            if (value := getattr(self, name)) is not None:
                checks.positive(name, value)
        checks.not_negative("longest_gap", self.longest_gap)
        checks.number("delay", self.delay)
        if self.align and self.delay:
            raise ValueError("align must be left out where delay is given: it finds the delay itself")
        if self.longest_gap and self.resample is None:
            raise ValueError("longest_gap needs resample")


def clean(log: FlightLog, cleaning: Cleaning, vehicle: Vehicle | None = None) -> tuple[FlightLog, list[str]]:
    """Apply some changes to a log; also return one line per change.

    Args:
        log: the log.
        cleaning: which changes.
        vehicle: the vehicle, which `align` needs.

    Raises:
        ValueError: the log, the field of `cleaning` and why it is impossible, in one line.
    """
    steps: dict[str, tuple[Any, Callable[[FlightLog, Any], tuple[FlightLog, str]]]] = {
        "in_flight": (cleaning.in_flight, lambda log, _: in_flight(log)),
        "resample": (cleaning.resample, lambda log, dt: resample(log, dt, cleaning.longest_gap)),
        "low_pass": (cleaning.low_pass, low_pass),
        "align": (cleaning.align, lambda log, _: align_motors(log, vehicle)),
        "delay": (cleaning.delay, delay_motors),
    }
    done: list[str] = []
    for name, (value, change) in steps.items():
        if not value:
            continue
        try:
            log, line = change(log, value)
        except ValueError as error:
            raise ValueError(f"{log.name}: {name}: {str(error).removeprefix(f'{log.name}: ')}") from error
        done.append(line)
    return log, done


def resample(log: FlightLog, dt: float, longest_gap: float = 0.0) -> tuple[FlightLog, str]:
    """Resample each segment at multiples of dt [s]: states linearly, attitudes spherically, motors as means.

    Args:
        log: the flight.
        dt: new interval between samples [s].
        longest_gap: interpolate across gaps and repeated samples up to this long [s].

    Raises:
        ValueError: dt is not positive, or all segments are shorter than dt.
    """
    if not dt > 0:
        raise ValueError(f"dt must be a positive number of seconds, got {dt!r}")
    fresh, parts = log[~repeats(log)], []
    for part in runs_of(np.diff(fresh.t) <= max(1.5 * log.dt, longest_gap), 1):
        piece = fresh[part]
        # The tolerance keeps the last sample despite rounded times.
        first, last = np.ceil(piece.t[0] / dt - 1e-6), np.floor(piece.t[-1] / dt + 1e-6)
        if last > first:
            t = np.clip(dt * np.arange(first, last + 1), piece.t[0], piece.t[-1])
            x = interpolate(t, piece.t, piece.x)
            x[:, QUATERNION] = interpolate_attitude(t, piece.t, piece.x[:, QUATERNION])
            parts.append(FlightLog(t, x, mean_of_held(t, piece.t, piece.u), log.name))
    if not parts:
        raise ValueError(f"{log.name}: no segment without gaps is as long as dt = {dt} s")
    # Without last samples of segments that would make a gap too short to be recognised as one.
    ends = [following.t[0] - GAP * dt for following in parts[1:]] + [np.inf]
    parts = [part[part.t < end] for part, end in zip(parts, ends, strict=True) if (part.t < end).any()]
    t, x, u = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t", "x", "u"))
    done = f"resampled {len(log)} samples to {len(t)} at {dt} s in {len(parts)} segments"
    return FlightLog(t, x, u, log.name), f"{done}, bridging gaps up to {longest_gap} s"


def in_flight(log: FlightLog) -> tuple[FlightLog, str]:
    """Cut out the time on the ground, where `airborne` says that the vehicle is not in the air.

    Args:
        log: the flight.

    Raises:
        ValueError: no samples remain.
    """
    flying = ~on_ground(log)
    if not flying.any():
        raise ValueError(f"{log.name}: the vehicle stays on the ground; leave the file out")
    return log[flying], f"{len(log) - flying.sum()} samples on the ground cut out"


def low_pass(log: FlightLog, cutoff: float) -> tuple[FlightLog, str]:
    """Filter states and motors with the same Butterworth filter, forward and back, segment by segment.

    Args:
        log: the flight, with even samples.
        cutoff: frequency of half the amplitude [Hz].

    Raises:
        ValueError: the cutoff is not between 0 and half the sampling frequency, or samples are not evenly spaced.
    """
    rate = 1 / log.dt
    if not 0 < cutoff < rate / 2:
        raise ValueError(f"cutoff must lie between 0 and half the sampling frequency {rate / 2:.6g} Hz, got {cutoff!r}")
    sections = scipy.signal.butter(2, cutoff, fs=rate, output="sos")
    log, all_samples = log[~repeats(log)], len(log)  # filtered, they could no longer be recognised
    x, u = log.x.copy(), log.u.copy()
    for part in even_segments(log):
        both = np.concatenate([x[part], u[part]], axis=1)
        both = scipy.signal.sosfiltfilt(sections, both, axis=0, padlen=min(9, len(both) - 1))
        x[part], u[part] = both[:, :STATE_SIZE], np.maximum(both[:, STATE_SIZE:], 0.0)
    x[:, QUATERNION] /= np.linalg.norm(x[:, QUATERNION], axis=1, keepdims=True)
    done = f"low-pass of second order at {cutoff:g} Hz, zero phase, states and motors"
    return FlightLog(log.t, x, u, log.name), f"{done}; {all_samples - len(log)} repeated samples left out"


def delay_motors(log: FlightLog, lag: float) -> tuple[FlightLog, str]:
    """Delay the motor values by `lag` [s]; samples that would need unknown values are cut.

    Args:
        log: the flight.
        lag: delay [s]; a negative one shifts the motors to earlier times.

    Raises:
        ValueError: no segment is longer than the lag.
    """
    parts = []
    for part in segments(log):
        piece = log[part]
        end = piece.t[-1] + log.dt  # the last value is held for one interval
        inside = (piece.t - lag >= piece.t[0] - 1e-9) & (piece.t + log.dt - lag <= end + 1e-9)
        if inside.sum() > 1:
            at = np.append(piece.t[inside], piece.t[inside][-1] + log.dt) - lag
            parts.append((piece.t[inside], piece[inside].x, mean_of_held(at, piece.t, piece.u)[:-1]))
    if not parts:
        raise ValueError(f"{log.name}: no segment without gaps is longer than the lag of {lag} s")
    t, x, u = map(np.concatenate, zip(*parts, strict=True))
    return FlightLog(t, x, u, log.name), f"motors shifted by {1000 * lag:.1f} ms, {len(log) - len(t)} samples cut"


def lag_motors(log: FlightLog, time_constant: float) -> tuple[FlightLog, str]:
    """Replace motors u by the mean over each interval of w with τ ẇ = u − w; segments start in equilibrium.

    Args:
        log: the flight, with even samples.
        time_constant: τ [s], at least 0.

    Raises:
        ValueError: the time constant is negative, or samples are not evenly spaced.
    """
    if not 0 <= time_constant < np.inf:
        raise ValueError(f"time_constant must be a number of seconds of at least 0, got {time_constant!r}")
    parts, u = even_segments(log), log.u.copy()
    if time_constant > 0:
        step = log.dt / time_constant
        kept = np.exp(-step)
        for part in parts:
            held = log.u[part]
            speed, _ = scipy.signal.lfilter([0.0, 1 - kept], [1.0, -kept], held, axis=0, zi=held[:1])
            u[part] = held + (speed - held) * (1 - kept) / step
    done = f"rotors follow the log's motors with a time constant of {1000 * time_constant:.1f} ms"
    return FlightLog(log.t, log.x, u, log.name), done


def align_motors(log: FlightLog, vehicle: Vehicle | None) -> tuple[FlightLog, str]:
    """Apply `delay_motors` with the lag of the best cross-correlation with the angular acceleration.

    Args:
        log: the flight.
        vehicle: the vehicle, for the places and spins of its rotors and its inertia.

    Raises:
        ValueError: there is no vehicle, or the log has too little motion to estimate the lag.
    """
    if vehicle is None:
        raise ValueError(f"{log.name}: needs a vehicle, for the places of its rotors")
    found = respond(log, vehicle)
    if found is None or sum(found.correlations[:2]) < 0.2:
        raise ValueError(f"{log.name}: roll and pitch do not follow the motors, so their lag cannot be estimated")
    return delay_motors(log, found.lag)
