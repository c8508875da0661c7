"""Split logs by flight, cut them into windows, and score predictions of these."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks, rotation
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.flights.checks.cleaning import Cleaning, lag_motors
from hybrid_jax.flights.checks.consistency import check_log
from hybrid_jax.flights.load import Failed, load_logs, report
from hybrid_jax.flights.log import FlightLog, even_segments, segments
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.runtime import FASTEST_COMPILE, entry, jit_with
from hybrid_jax.trajectories import Trajectories, check, concatenate, windows_of
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, STATE_SIZE, VELOCITY, Vehicle

CHUNK = 500  # windows that are predicted at a time
Split = tuple[list[FlightLog], list[FlightLog]]  # training, held out
Errors = Float[Array | np.ndarray, "*n"]
_SUFFIX = re.compile(r"(\.csv|\.csv\.gz|\.ulg|\.mcap|\.db3|\.bag|\.bbl|\.bfl|\.gz)$", re.IGNORECASE)
_RUN = re.compile(r"[_\- ]*((run|flight|take|log)[_\- ]*|[_\- ])\d+$", re.IGNORECASE)


def load_windows(
    folder: str | Path,
    vehicle: Vehicle,
    *,
    dt: float | None = None,
    steps: int = 10,
    stride: int = 1,
    columns: str | Path | None = None,
    polynomial: tuple[float, ...] = (),
    topics: Mapping[str, str] | None = None,
    motor_order: Sequence[int] = (),
    motor_time_constant: float = 0.0,
    cleaning: Cleaning | None = None,
    failed: Failed = "refuse",
) -> Trajectories:
    """Read all logs of a folder, check them against the vehicle and cut them into windows; ValueError for invalid ones.

    Windows never cross a gap or a repeated sample. Motors are constant in each interval of a window, so faster motor
    signals are averaged. You get a warning of one line for each check that warns, for example for slow motor signals.

    Args:
        folder: folder with one log per flight, in any format that `read_recording` reads; other files are ignored.
        vehicle: the vehicle to check the logs against.
        dt: interval [s] to which logs are resampled if they have another one. By default all logs must share one, and
            logs whose signals have different times get 0.01.
        steps: number of intervals in each window.
        stride: number of samples between the starts of two windows.
        columns: TOML file that describes the columns of CSV logs, see `hybrid_jax.flights.formats.column_map`; by
            default the library's columns and units.
        polynomial: rotor speed [rad/s] = Σ polynomial[i] commandⁱ. Logs with commands (0 to 1) but no speeds need it.
        topics: topics of a ROS bag by quantity: see `hybrid_jax.flights.formats.rosbag`.
        motor_order: index in the log of each rotor's motor, from 0.
        motor_time_constant: first-order lag [s] of the rotors. Logs with commands instead of rotor speeds need it.
        cleaning: changes to every log, for example `Cleaning(in_flight=True)`; by default none.
        failed: give "warn" if a failed check should warn instead of raising an error.

    Returns:
        Windows in float32: x0 (n, 13), u (n, steps, rotors) [rad/s], x (n, steps, 13), as in `hybrid_jax.vehicle`.
    """
    checks.count("steps", steps)
    checks.count("stride", stride)
    checks.not_negative("motor_time_constant", motor_time_constant)
    if dt is not None:
        checks.positive("dt", dt, "a positive number of seconds")
    given = {"columns": columns, "polynomial": polynomial, "topics": topics, "motor_order": motor_order}
    logs = load_logs(folder, **given, dt=dt, cleaning=cleaning, vehicle=vehicle, failed=failed)
    report([(log.name, check) for log in logs for check in check_log(log, vehicle)], failed)
    require_common_interval(logs)
    return cut_windows([lag_motors(log, motor_time_constant) for log in logs], steps, stride)


def flight_of(log: FlightLog) -> str:
    """Return the name of a flight's file without folder and suffix."""
    return _SUFFIX.sub("", Path(log.name).name)


def manoeuvre_of(log: FlightLog) -> str:
    """Remove the run number from a flight's name: "chirp_run2" and "chirp-03" give "chirp", "figure8" stays."""
    return _RUN.sub("", flight_of(log)) or flight_of(log)


def hold_out(logs: Sequence[FlightLog], names: Sequence[str], of: Callable[[FlightLog], str] = flight_of) -> Split:
    """Split flights into flights for training and held-out flights. You should do this before you cut windows.

    Args:
        logs: the flights.
        names: the names of the flights to hold out; ValueError if one is unknown, or if none or all are named.
        of: function that names a flight, for example `flight_of` or `manoeuvre_of`.
    """
    known = sorted({of(log) for log in logs})
    for name in names:
        if name not in known:
            raise ValueError(f"names: no flight is called {name!r}, only {', '.join(known)}")
    split = [log for log in logs if of(log) not in names], [log for log in logs if of(log) in names]
    if not all(split):
        found = f"{len(split[0])} flights for training and {len(split[1])} held out"
        raise ValueError(f"names: {found}; each side needs one")
    return split


def folds(
    logs: Sequence[FlightLog], count: int | None = None, of: Callable[[FlightLog], str] = flight_of, seed: int = 0
) -> list[Split]:
    """Split flights several times, so that each is held out once, together with all flights of the same name.

    Args:
        logs: the flights.
        count: number of splits; by default one for each name. ValueError unless it is from 2 to the number of names.
        of: function that names a flight, for example `flight_of` or `manoeuvre_of`.
        seed: random seed for assigning names to splits.
    """
    names = sorted({of(log) for log in logs})
    count = len(names) if count is None else count
    if not 2 <= count <= len(names):
        raise ValueError(f"count must be from 2 to the {len(names)} different names of the flights, got {count}")
    dealt = np.random.default_rng(seed).permutation(np.array(names, object))
    return [hold_out(logs, list(dealt[i::count]), of) for i in range(count)]


def require_common_interval(logs: Sequence[FlightLog]) -> float:
    """Return the interval [s] between samples; raise ValueError if the logs differ."""
    for log in logs:
        even_segments(log)
        if log.dt != logs[0].dt:
            raise ValueError(
                f"{log.name}: samples are {log.dt:g} s apart, but {logs[0].dt:g} s in {logs[0].name}; "
                f"resample all logs with dt={max(log.dt, logs[0].dt):g}"
            )
    return logs[0].dt


def sequences(logs: Sequence[FlightLog], steps: int) -> list[Trajectories]:
    """Return each part without gaps of evenly sampled logs as one window, if it has more than `steps` intervals."""
    parts = [(log, part) for log in logs for part in even_segments(log) if part.stop - part.start > steps]
    found = [windows_of(log.x[p], log.u[p][:-1], log.dt, steps=p.stop - p.start - 1) for log, p in parts]
    return [jax.tree.map(lambda leaf: leaf.astype(np.float32), each) for each in found]


def cut_windows(logs: Sequence[FlightLog], steps: int, stride: int = 1, most: int | None = None) -> Trajectories:
    """Cut logs into windows of `steps` intervals without gaps. Logs shorter than a window are skipped.

    Args:
        logs: flights, which should be evenly sampled.
        steps: number of intervals in each window.
        stride: number of samples between the starts of two windows.
        most: the largest number of windows to return, spread evenly; by default all.

    Returns:
        Windows in float32, ordered by flight.

    Raises:
        ValueError: if all logs are shorter than a window, or samples are not evenly spaced.
    """
    return concatenate(cut_each(logs, steps, stride, most))


def cut_each(logs: Sequence[FlightLog], steps: int, stride: int = 1, most: int | None = None) -> list[Trajectories]:
    """Return the windows of each flight that has any, as separate batches; see `cut_windows`."""
    parts = []
    for log in require_length(logs, steps):
        long = [part for part in even_segments(log) if part.stop - part.start > steps]
        cut = [windows_of(log.x[p], log.u[p][:-1], log.dt, steps=steps, stride=stride) for p in long]
        parts.append(jax.tree.map(lambda leaf: leaf.astype(np.float32), concatenate(cut)))
    ends = np.cumsum([len(part) for part in parts])
    if most is None or ends[-1] <= most:
        return parts
    kept = np.round(np.linspace(0, ends[-1] - 1, most)).astype(int)
    places = np.split(kept, np.searchsorted(kept, ends[:-1]))
    return [part[own - end] for part, own, end in zip(parts, places, ends, strict=True) if len(own)]


def require_length(logs: Sequence[FlightLog], steps: int) -> list[FlightLog]:
    """Return the logs with at least one window of `steps` intervals; ValueError if no log has one."""
    longest = [max((part.stop - part.start - 1 for part in segments(log)), default=0) for log in logs]
    if not (long := [log for log, length in zip(logs, longest, strict=True) if length >= steps]):
        names = ", ".join(map(flight_of, logs))
        raise ValueError(
            f"no window of {steps} intervals without gaps in {names}; the longest segment has "
            f"{max(longest, default=0)}: bridge gaps or use shorter windows"
        )
    return long


class FlightErrors(NamedTuple):
    """The sizes of the errors of predicted states, each (n, t) for n windows of t intervals.

    Attributes:
        position: norm of the error [m].
        velocity: norm of the error [m/s].
        rotation: angle from the predicted attitude to the true one [rad], 0 … π.
        body_rates: norm of the error [rad/s].
    """

    position: Errors
    velocity: Errors
    rotation: Errors
    body_rates: Errors


def errors_between(predicted: Float[Array, "*n 13"], truth: Float[Array, "*n 13"]) -> FlightErrors:
    turns = jnp.vectorize(rotation.attitude_error, signature="(q),(q)->(v)")
    parts = [predicted[..., part] - truth[..., part] for part in (POSITION, VELOCITY, BODY_RATES)]
    parts.insert(2, turns(truth[..., QUATERNION], predicted[..., QUATERNION]))
    return FlightErrors(*(jnp.linalg.norm(part, axis=-1) for part in parts))


@entry
def flight_errors(field: AbstractVectorField, windows: Trajectories) -> FlightErrors:
    """Predict each window with a field in inference mode, and return the errors at the end of each interval.

    Args:
        field: the model.
        windows: measured states and inputs; the first 13 numbers of a state are as in `hybrid_jax.vehicle`.

    Raises:
        ValueError: if the windows are malformed, or their states are not a multirotor's.
    """
    if check(windows, "windows").x.shape[-1] < STATE_SIZE:
        raise ValueError(f"windows: states of {STATE_SIZE} expected, as in vehicle.py, got {windows.x.shape[-1]}")
    RIGID_BODY_SPACE.check("windows: x0", windows.x0)
    RIGID_BODY_SPACE.check("windows: x", windows.x)
    # The last part is padded to full length, so that all parts share one program.
    parts = (np.arange(start, start + CHUNK) % len(windows) for start in range(0, len(windows), CHUNK))
    found = [jax.device_get(_errors(field, windows[part])) for part in parts]
    return FlightErrors(*(np.concatenate(arrays)[: len(windows)] for arrays in zip(*found, strict=True)))


@jit_with(FASTEST_COMPILE)
def _errors(field, windows: Trajectories) -> FlightErrors:
    predicted = rollout_batch(field, windows.x0, windows.u, windows.dt)
    return errors_between(*(each[..., :STATE_SIZE] for each in (predicted, jnp.asarray(windows.x))))
