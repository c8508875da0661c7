"""Split recorded logs by flight or manoeuvre and cut them into windows, which overlap and share wind and load."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from hybrid_jax import checks
from hybrid_jax.flights.checks.cleaning import Cleaning, lag_motors
from hybrid_jax.flights.checks.consistency import check_log
from hybrid_jax.flights.load import Failed, load_logs, report
from hybrid_jax.flights.log import FlightLog, even_segments, segments
from hybrid_jax.trajectories import Trajectories, concatenate, windows_of
from hybrid_jax.vehicle import Vehicle

Split = tuple[list[FlightLog], list[FlightLog]]  # training, held out
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
    """Read all logs of a folder, check them against the vehicle and cut them into windows.

    Windows never cross a gap or a repeated sample. You get a warning of one line for each check that warns. Motors are
    constant in each interval of a window, so faster motor signals are averaged, and you get a warning if they were
    sampled too slowly.

    Args:
        folder: folder with one log per flight, in any format that `read_recording` reads; other files are ignored.
        vehicle: the vehicle to check the logs against.
        dt: interval [s] to which logs of other intervals are resampled; by default all logs must share one, and those
            whose signals have times of their own get 0.01.
        steps: number of intervals in each window.
        stride: number of samples between the starts of two windows.
        columns: TOML file that names the columns of CSV logs, see `hybrid_jax.flights.formats.column_map`; by default
            the library's columns and units.
        polynomial: rotor speed [rad/s] = Σ polynomial[i] commandⁱ, for logs with commands (0 to 1) but no speeds.
        topics: topics of a ROS bag by quantity: see `hybrid_jax.flights.formats.rosbag`.
        motor_order: index in the log of each rotor's motor, from 0.
        motor_time_constant: first-order lag [s] of the rotors, for logs with commands instead of rotor speeds.
        cleaning: changes to every log, for example `Cleaning(in_flight=True)`; by default none.
        failed: whether a failed check raises an error ("refuse") or warns ("warn").

    Returns:
        Windows in float32: x0 (n, 13), u (n, steps, rotors) [rad/s], x (n, steps, 13), as in `hybrid_jax.vehicle`.

    Raises:
        ValueError: if a file or argument is invalid.
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
    """Split flights into those for training and those that are held out.

    Args:
        logs: the flights.
        names: the names of the flights to hold out.
        of: function that names a flight, for example `flight_of` or `manoeuvre_of`.

    Raises:
        ValueError: if a name is unknown, or one side is empty.
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
    """Split flights several times, so that each is held out once, together with all flights of its name.

    Args:
        logs: the flights.
        count: number of splits; by default one for each name.
        of: function that names a flight, for example `flight_of` or `manoeuvre_of`.
        seed: random seed for assigning names to splits.

    Raises:
        ValueError: if count is less than 2 or more than the number of names.
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
                f"{log.name}: samples are {log.dt:g} s apart, those of {logs[0].name} {logs[0].dt:g} s; "
                f"resample all logs with dt={max(log.dt, logs[0].dt):g}"
            )
    return logs[0].dt


def sequences(logs: Sequence[FlightLog], steps: int) -> list[Trajectories]:
    """Return each part of evenly sampled logs without gaps as one window, if it has more than `steps` intervals."""
    parts = [(log, part) for log in logs for part in even_segments(log) if part.stop - part.start > steps]
    found = [windows_of(log.x[p], log.u[p][:-1], log.dt, steps=p.stop - p.start - 1) for log, p in parts]
    return [jax.tree.map(lambda leaf: leaf.astype(np.float32), each) for each in found]


def cut_windows(logs: Sequence[FlightLog], steps: int, stride: int = 1, most: int | None = None) -> Trajectories:
    """Cut logs into windows of `steps` intervals without gaps. Logs shorter than a window are skipped.

    Args:
        logs: evenly sampled flights.
        steps: number of intervals in each window.
        stride: number of samples between the starts of two windows.
        most: the largest number of windows to return, spread evenly; by default all.

    Returns:
        Windows in float32, ordered by flight.

    Raises:
        ValueError: if all logs are shorter than a window, or samples are not evenly spaced.
    """
    parts = []
    for log in require_length(logs, steps):
        long = [part for part in even_segments(log) if part.stop - part.start > steps]
        cut = [windows_of(log.x[p], log.u[p][:-1], log.dt, steps=steps, stride=stride) for p in long]
        parts.append(concatenate(cut))
    windows = jax.tree.map(lambda leaf: leaf.astype(np.float32), concatenate(parts))
    if most is None or len(windows) <= most:
        return windows
    return windows[np.round(np.linspace(0, len(windows) - 1, most)).astype(int)]


def require_length(logs: Sequence[FlightLog], steps: int) -> list[FlightLog]:
    """Return the logs with at least one window of `steps` intervals; raise ValueError if there are none."""
    longest = [max((part.stop - part.start - 1 for part in segments(log)), default=0) for log in logs]
    if not (long := [log for log, length in zip(logs, longest, strict=True) if length >= steps]):
        names = ", ".join(map(flight_of, logs))
        raise ValueError(
            f"no window of {steps} intervals without gaps in {names}; the longest segment has "
            f"{max(longest, default=0)}: bridge gaps or use shorter windows"
        )
    return long
