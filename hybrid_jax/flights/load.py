"""Load logs of any format: one, or all of a folder, checked before they become flights."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from hybrid_jax.flights.checks.consistency import FAILS, WARNS, Check
from hybrid_jax.flights.checks.suitability import check_recording
from hybrid_jax.flights.conversion import DT, to_flight
from hybrid_jax.flights.formats.column_map import ColumnMap, load_column_map, read_mapped
from hybrid_jax.flights.formats.csv import notes_on_end, read_csv
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.reading import CSV, SUFFIXES, find_logs, format_of, read_recording, recording_of, reordered
from hybrid_jax.flights.recording import Recording
from hybrid_jax.vehicle import Vehicle

Failed = Literal["refuse", "warn"]


class Reading(NamedTuple):
    """A log as it was recorded, and the samples of one that stand on common times already, as those of a CSV file."""

    recording: Recording
    log: FlightLog | None = None

    def flight(self, dt: float | None = None, polynomial: Sequence[float] = ()) -> FlightLog:
        """The flight at its own times, or at intervals of dt [s]: see `to_flight`."""
        return to_flight(self.recording, dt or DT, polynomial) if self.log is None else self.log


def load_logs(
    folder: str | Path,
    *,
    columns: ColumnMap | str | Path | None = None,
    polynomial: tuple[float, ...] = (),
    topics: Mapping[str, str] | None = None,
    motor_order: Sequence[int] = (),
    dt: float | None = None,
    vehicle: Vehicle | None = None,
    failed: Failed = "refuse",
) -> list[FlightLog]:
    """Read all logs of a folder in the order of their names and run `check_recording`; arguments as of `load_windows`.

    Raises:
        ValueError: the folder holds no logs, or the file, row, field and what to do, in one line.
    """
    if failed not in (known := get_args(Failed)):
        raise ValueError(f"failed must be one of {', '.join(known)}, got {failed!r}")
    readings = read_folder(folder, columns=columns, topics=topics, motor_order=motor_order)[0]
    found = [
        (reading.recording.name, check)
        for reading in readings
        for check in check_recording(reading.recording, vehicle, asked_interval(reading, dt))
    ]
    report(found, failed)
    return [reading.flight(dt, polynomial) for reading in readings]


def asked_interval(reading: Reading, dt: float | None) -> float | None:
    """The interval [s] that a flight will have, if its samples do not stand at it already."""
    return dt or (DT if reading.log is None else None)


def report(found: Sequence[tuple[str, Check]], failed: Failed) -> None:
    """Raise ValueError for the first check that failed, or warn; `found` are names of logs and their checks."""
    lines = {FAILS: [], WARNS: []}
    for name, check in found:
        lines.get(check.verdict, []).append(f"{name}: {check.name}: {check.suggestion}")
    if lines[FAILS] and failed == "refuse":
        more = f" ({len(lines[FAILS]) - 1} more checks failed)" if len(lines[FAILS]) > 1 else ""
        raise ValueError(f'{lines[FAILS][0]}{more}; failed="warn" goes on all the same')
    for line in (*lines[FAILS], *lines[WARNS]):
        warnings.warn(line, stacklevel=3)


def read_folder(
    folder: str | Path,
    *,
    columns: ColumnMap | str | Path | None = None,
    topics: Mapping[str, str] | None = None,
    motor_order: Sequence[int] = (),
) -> tuple[list[Reading], dict[Path, str]]:
    """Read all logs of a folder, in the order of their names; also its other files, each with why it is left.

    Raises:
        ValueError: the folder holds no logs, or the file, row, field and what to do, in one line.
    """
    paths, left = find_logs(folder)
    if not paths:
        others = "; ".join(f"{path.name}: {why}" for path, why in [*left.items()][:5])
        found = f"; it holds {others}" if left else ""
        raise ValueError(f"{folder}: holds no flights ({', '.join(SUFFIXES)}){found}")
    if isinstance(columns, str | Path):
        columns = load_column_map(columns)
    return [read_log(path, columns=columns, topics=topics, motor_order=motor_order) for path in paths], left


def read_log(
    path: str | Path,
    *,
    columns: ColumnMap | None = None,
    topics: Mapping[str, str] | None = None,
    motor_order: Sequence[int] = (),
) -> Reading:
    """Read one log of any format of `read_recording`; arguments and errors as of it."""
    if format_of(path) != CSV:
        return Reading(read_recording(path, columns, topics, motor_order))
    log = read_csv(path) if columns is None else read_mapped(path, columns)
    if len(log) < 2:
        raise ValueError(f"{path}: row 2, field t: a flight needs at least two samples; leave the file out")
    recording = replace(recording_of(log), notes=notes_on_end(path))
    if len(motor_order):
        recording = reordered(recording, motor_order)
        log = FlightLog(log.t, log.x, recording.signals["rotor_speed"].values, log.name)
    return Reading(recording, log)


def load_log(
    path: str | Path,
    *,
    columns: ColumnMap | None = None,
    polynomial: tuple[float, ...] = (),
    topics: Mapping[str, str] | None = None,
    motor_order: Sequence[int] = (),
    dt: float | None = None,
) -> FlightLog:
    """Read one log, without checking it. See `load_windows` for the arguments.

    Raises:
        ValueError: the file, row, field and what to do, in one line.
    """
    return read_log(path, columns=columns, topics=topics, motor_order=motor_order).flight(dt, polynomial)
