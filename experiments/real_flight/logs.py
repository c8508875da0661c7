"""Folders of logs: read, checked against the vehicle, cleaned as asked for, and what of this a report must say."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.real_flight.config import Cleaning, RealFlightConfig
from hybrid_jax.flights.cleaning import (
    align_motors,
    delay_motors,
    even_segments,
    in_flight,
    lag_motors,
    low_pass,
    resample,
    windows,
)
from hybrid_jax.flights.column_map import ColumnMap, load_column_map, read_mapped
from hybrid_jax.flights.consistency import FAILS, check_log
from hybrid_jax.flights.flight_csv import read_csv
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.segments import gaps, repeats, segments
from hybrid_jax.flights.splits import SUFFIXES, flight_of
from hybrid_jax.flights.ulog import read_ulog
from hybrid_jax.io.archive import digest
from hybrid_jax.trajectories import Trajectories, concatenate, windows_of
from hybrid_jax.vehicle import Vehicle


@dataclass(frozen=True)
class Flown:
    """The flights of one folder.

    Attributes:
        label: what they are for: "source", "target" or "test".
        logs: cleaned.
        records: of each flight, as JSON values: its samples, their SHA-256, its gaps, the checks on it as it was read,
            what was done.
    """

    label: str
    logs: list[FlightLog]
    records: list[dict[str, Any]]


def fly_in(option: str, folder: Path, vehicle: Vehicle, time_constant: float, config: RealFlightConfig) -> Flown:
    """All flights of a folder.

    Args:
        option: by which the folder was given, without dashes.
        time_constant: of the vehicle's rotors behind the log's motor values [s].

    Raises:
        ValueError: file, row, field and what to do, in one line.
    """
    columns = None if config.columns is None else load_column_map(config.columns)
    logs, records = [], []
    for path in _files(option, folder):
        raw = _read(path, columns, config)
        log, done = cleaned(raw, config.cleaning, vehicle)
        if time_constant:
            log, said = lag_motors(log, time_constant)
            done.append(said)
        logs.append(log)
        records.append({"folder": option} | _record(raw, log, vehicle, done))
    return Flown(option, logs, records)


def require_one_rate(flown: Sequence[Flown]) -> float:
    """The interval [s] between samples, the same in all flights.

    Raises:
        ValueError: two flights of which it differs, or one in which it does.
    """
    logs = [log for each in flown for log in each.logs]
    for log in logs:
        even_segments(log)
        if log.dt != logs[0].dt:
            raise ValueError(
                f"{log.name}: samples are {log.dt:g} s apart, those of {logs[0].name} {logs[0].dt:g} s; "
                f"give all the same with --cleaning.resample {max(log.dt, logs[0].dt):g}"
            )
    return logs[0].dt


def require_distinct(flown: Sequence[Flown], config: RealFlightConfig) -> None:
    """Refuse a flight that is there twice, whatever its files are called: it would teach, or stop, and judge.

    Source and test may have flights in common where each is tested by models of other manoeuvres.

    Raises:
        ValueError: both files, and what to do.
    """
    shared = config.target is None and config.folds_by == "manoeuvre"
    first: dict[tuple[str, str], str] = {}
    for each in flown:
        for log, record in zip(each.logs, each.records, strict=True):
            key, file = (each.label if shared else "", record["sha256"]), f"--{each.label} {log.name}"
            if key in first:
                raise ValueError(f"{file}: the same flight as {first[key]}; leave one of the two out")
            first[key] = file


def cleaned(log: FlightLog, cleaning: Cleaning, vehicle: Vehicle) -> tuple[FlightLog, list[str]]:
    """The log after each change that was asked for, and a line for each.

    Raises:
        ValueError: the flight, the option and why it cannot be done, in one line.
    """
    done: list[str] = []

    def apply(option: str, change: Callable[..., tuple[FlightLog, str]], *values: Any) -> FlightLog:
        try:
            changed, said = change(log, *values)
        except ValueError as error:
            why = str(error).removeprefix(f"{log.name}: ")
            raise ValueError(f"{log.name}: --cleaning.{option}: {why}") from error
        done.append(said)
        return changed

    if cleaning.in_flight:
        log = apply("in-flight", in_flight)
    if cleaning.resample is not None:
        log = apply("resample", resample, cleaning.resample, cleaning.longest_gap)
    if cleaning.low_pass is not None:
        log = apply("low-pass", low_pass, cleaning.low_pass)
    if cleaning.align:
        log = apply("align", align_motors, vehicle)
    if cleaning.delay:
        log = apply("delay", delay_motors, cleaning.delay)
    return log, done


@dataclass(frozen=True)
class Windows:
    """Windows of some flights, float32, one every `stride` samples, and how many each flight has, in order."""

    windows: Trajectories
    sizes: list[int]
    stride: int

    def __len__(self) -> int:
        return len(self.windows)


def cut(logs: Sequence[FlightLog], steps: int, stride: int = 1) -> Windows:
    """All windows within segments without gaps; flights too short for one are left out.

    Raises:
        ValueError: no flight is as long as a window, or samples that are not evenly spaced.
    """
    long = long_enough(logs, steps)
    parts = [windows(log, steps, stride) for log in long]
    return Windows(_single(concatenate(parts)), [len(part) for part in parts], stride)


def long_enough(logs: Sequence[FlightLog], steps: int) -> list[FlightLog]:
    """The flights that have a window of `steps` intervals.

    Raises:
        ValueError: none has.
    """
    long = [log for log in logs if max(_intervals(log), default=0) >= steps]
    if not long:
        names = ", ".join(flight_of(log) for log in logs)
        raise ValueError(f"no window of {steps} intervals without gaps in {names}; bridge gaps or shorten --horizon")
    return long


def count_windows(logs: Sequence[FlightLog], steps: int) -> int:
    """How many windows `cut` finds, one at every sample."""
    return sum(max(0, length - steps + 1) for log in logs for length in _intervals(log))


@dataclass(frozen=True)
class Stretch:
    """The longest segment of a flight as windows that touch; `begin` is when it starts [s], from the flight's first
    sample on.
    """

    flight: FlightLog
    begin: float
    windows: Trajectories


def stretch(logs: Sequence[FlightLog], steps: int) -> Stretch:
    """Of the first flight that has a window of `steps` intervals.

    Raises:
        ValueError: none has.
    """
    flight = long_enough(logs, steps)[0]
    part = max(segments(flight), key=lambda part: part.stop - part.start)
    touching = windows_of(flight.x[part], flight.u[part][:-1], flight.dt, steps=steps)
    return Stretch(flight, float(flight.t[part.start] - flight.t[0]), _single(touching))


def _single(windows: Trajectories) -> Trajectories:
    return jax.tree.map(lambda leaf: leaf.astype(np.float32), windows)


def _intervals(log: FlightLog) -> list[int]:
    """How many there are in each segment."""
    return [part.stop - part.start - 1 for part in segments(log)]


def _files(option: str, folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise ValueError(f"--{option} {folder}: no such folder")
    seen = (path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    files = sorted(path for path in seen if path.name.lower().endswith(SUFFIXES))
    if not files:
        raise ValueError(f"--{option} {folder}: holds no flights ({', '.join(SUFFIXES)})")
    return files


def _read(path: Path, columns: ColumnMap | None, config: RealFlightConfig) -> FlightLog:
    if path.name.lower().endswith(".ulg"):
        try:
            return read_ulog(path, polynomial=config.polynomial)
        except ImportError as error:
            raise ValueError(f"{path}: {error}") from error
    log = read_csv(path) if columns is None else read_mapped(path, columns)
    if len(log) < 2:
        raise ValueError(f"{path}: row 2, field t: one sample is no flight; leave the file out")
    return log


def _record(raw: FlightLog, log: FlightLog, vehicle: Vehicle, done: list[str]) -> dict[str, Any]:
    checks = [asdict(check) for check in check_log(raw, vehicle)]
    return {
        "flight": flight_of(raw),
        "sha256": digest(None, {"t": raw.t, "x": raw.x, "u": raw.u}),
        "samples": len(raw),
        "seconds": round(float(raw.t[-1] - raw.t[0]), 3),
        "dt": raw.dt,
        "gaps": int(gaps(raw).sum()),
        "repeated_samples": int(repeats(raw).sum()),
        "used_samples": sum(part.stop - part.start for part in segments(log)),
        "done": done,
        "fails": sum(check["verdict"] == FAILS for check in checks),
        "checks": checks,
    }
