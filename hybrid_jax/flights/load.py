"""Load logs of any format (detected from the first bytes and the suffix), check them and clean them."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from hybrid_jax import checks
from hybrid_jax.flights.checks.cleaning import Cleaning, clean
from hybrid_jax.flights.checks.consistency import FAILS, WARNS, Check
from hybrid_jax.flights.checks.suitability import check_recording
from hybrid_jax.flights.conversion import DT, flight_at, own_rows
from hybrid_jax.flights.formats.blackbox import read_blackbox
from hybrid_jax.flights.formats.column_map import load_column_map, read_mapped
from hybrid_jax.flights.formats.crazyflie import is_crazyflie, read_crazyflie
from hybrid_jax.flights.formats.raw import GZIP, readable, record
from hybrid_jax.flights.formats.rosbag import read_rosbag
from hybrid_jax.flights.formats.ulog import read_ulog
from hybrid_jax.flights.log import FlightLog, unevenness
from hybrid_jax.flights.recording import ROTOR_UNITS, Recording, axes_of
from hybrid_jax.vehicle import Vehicle

CSV, ULOG, CRAZYFLIE, ROSBAG, BLACKBOX = "CSV", "PX4 ULog", "Crazyflie µSD", "rosbag", "Betaflight blackbox"
SUFFIXES = {".csv": CSV, ".csv.gz": CSV, ".ulg": ULOG, ".mcap": ROSBAG, ".db3": ROSBAG, ".bag": ROSBAG}
SUFFIXES |= {".bbl": BLACKBOX, ".bfl": BLACKBOX}
MAGICS = {b"ULog": ULOG, b"\x89MCAP": ROSBAG, b"SQLite format 3": ROSBAG, b"#ROSBAG": ROSBAG}
MAGICS |= {b"H Product:Blackbox": BLACKBOX}
# Unsupported formats, by their first bytes or suffix, with what to do instead.
CONVERT = (
    "an ArduPilot DataFlash log, not read: mavlogdump.py --format csv --types TYPE FILE > TYPE.csv for TYPE ATT, "
    "IMU, XKF1 and RCOU; join them to one table by TimeUS, with empty cells, and say what it contains: "
    'columns="MAP.toml" (docs/howto/logs.md has the program and the map)'
)
PX4LOG = "a log of PX4's sdlog2, not read: log .ulg, as PX4 does from 1.4 on"
UNREAD = {".px4log": PX4LOG, b"\xa3\x95\x80": CONVERT, b"FMT, 128": CONVERT}
UNREAD |= {b"PK\x03\x04": "a zip archive: unpack it and give its logs"}
UNREAD |= {".tlog": "MAVLink telemetry, not read: it is too slow; give the log of the vehicle's own card"}
OTHER = "not a supported format"
BAG = "metadata.yaml"  # makes a folder one recording of ROS 2
Failed = Literal["refuse", "warn"]


def load_log(
    path: str | Path,
    *,
    columns: str | Path | None = None,
    polynomial: tuple[float, ...] = (),
    topics: Mapping[str, str] | None = None,
    motor_order: Sequence[int] = (),
    dt: float | None = None,
) -> FlightLog:
    """Read one log without checking it; for this, you should use `check_recording` and `check_log`.

    If it cannot be read, the ValueError names file, row, field and what to do.

    Args:
        path: a log of any format that `read_recording` reads.
        columns: see `load_windows`.
        polynomial: see `load_windows`.
        topics: see `load_windows`.
        motor_order: see `load_windows`.
        dt: interval between samples [s] if the signals have times of their own, by default 0.01; otherwise ignored.
    """
    return flight_at(read_recording(path, columns, topics, motor_order), dt, polynomial)


def load_logs(
    folder: str | Path,
    *,
    columns: str | Path | None = None,
    polynomial: tuple[float, ...] = (),
    topics: Mapping[str, str] | None = None,
    motor_order: Sequence[int] = (),
    dt: float | None = None,
    cleaning: Cleaning | None = None,
    vehicle: Vehicle | None = None,
    failed: Failed = "refuse",
) -> list[FlightLog]:
    """Read all logs of a folder in alphabetical order, check them with `check_recording` and clean them.

    Args:
        folder: see `load_windows`.
        columns: see `load_windows`.
        polynomial: see `load_windows`.
        topics: see `load_windows`.
        motor_order: see `load_windows`.
        dt: see `load_windows`.
        cleaning: changes to every log, by default none.
        vehicle: the expected vehicle. You should give it, because the motors are not checked otherwise.
        failed: give "warn" if a failed check should warn instead of raising an error.

    Raises:
        ValueError: if the folder has no logs, or one of them is invalid, with file, row, field and what to do.
    """
    if failed not in (known := get_args(Failed)):
        raise ValueError(f"failed must be one of {', '.join(known)}, got {failed!r}")
    cleaning = cleaning or Cleaning()
    dt = cleaning.resample if dt is None else dt
    paths, left = find_logs(folder)
    if not paths:
        others = "; ".join(f"{path.name}: {why}" for path, why in [*left.items()][:5])
        found = f"; it contains {others}" if left else ""
        raise ValueError(f"{folder}: contains no flights ({', '.join(SUFFIXES)}){found}")
    raws = [read_recording(path, columns, topics, motor_order) for path in paths]
    intervals = [dt or getattr(own_rows(raw), "dt", DT) for raw in raws]
    found = [(raw.name, check_recording(raw, vehicle, own)) for raw, own in zip(raws, intervals, strict=True)]
    report([(name, check) for name, checks in found for check in checks], failed)

    def cleaned(log: FlightLog) -> FlightLog:
        fits = dt is None or (log.dt == dt and not unevenness(log).any())
        return clean(log, replace(cleaning, resample=None if fits else dt))[0]

    return [cleaned(flight_at(raw, dt, polynomial)) for raw in raws]


def report(found: Sequence[tuple[str, Check]], failed: Failed) -> None:
    """Raise ValueError for the first failed check, or warn; `found` are pairs of a log's name and a check."""
    lines = {FAILS: [], WARNS: []}
    for name, check in found:
        lines.get(check.verdict, []).append(f"{name}: {check.name}: {check.suggestion}")
    if lines[FAILS] and failed == "refuse":
        more = f" ({len(lines[FAILS]) - 1} more checks failed)" if len(lines[FAILS]) > 1 else ""
        raise ValueError(f'{lines[FAILS][0]}{more}; to continue anyway, use failed="warn"')
    for line in (*lines[FAILS], *lines[WARNS]):
        checks.warn(line)


def format_of(path: str | Path) -> tuple[str, str]:
    """Return the format of a file or folder; or "" and why it cannot be read."""
    path = Path(path)
    if path.is_dir():
        return (ROSBAG, "") if (path / BAG).is_file() else ("", "a folder; give it by itself")
    if not path.is_file():
        return "", "not a regular file"
    head, name = _head(path), path.name.lower()
    if is_crazyflie(head):
        return CRAZYFLIE, ""
    for mark, kind in (MAGICS | UNREAD | SUFFIXES).items():
        if head.startswith(mark) if isinstance(mark, bytes) else name.endswith(mark):
            return ("", kind.replace("FILE", path.name)) if mark in UNREAD else (kind, "")
    return "", OTHER if head or path.stat().st_size else "empty"


def _head(path: str | Path, unpack: bool = True) -> bytes:
    """Return the first bytes of a file; empty if it cannot be read, so that the reader reports why."""
    with contextlib.suppress(ValueError), readable(path, unpack) as file:
        return file.read(32)
    return b""


def find_logs(folder: str | Path) -> tuple[list[Path], dict[Path, str]]:
    """List the logs of a folder in alphabetical order, and its other files with the reasons for skipping them.

    Args:
        folder: folder of logs; ValueError if it does not exist. Hidden files are ignored, and a ROS bag is one log.
    """
    folder, logs, left = Path(folder), [], {}
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
    if format_of(folder)[0]:
        return [folder], {}
    for path in (path for path in sorted(folder.iterdir()) if not path.name.startswith(".")):
        kind, why = format_of(path)
        if kind:
            logs.append(path)
        else:
            left[path] = why
    return logs, left


def read_recording(
    path: str | Path,
    columns: str | Path | None = None,
    topics: Mapping[str, str] | None = None,
    motor_order: Sequence[int] = (),
) -> Recording:
    """Read one log of any supported format; ValueError, with file, topic or column, and time, if it is invalid.

    Args:
        path: a file, or the folder of a ROS bag.
        columns: see `load_windows`.
        topics: topics of a ROS bag by quantity: see `hybrid_jax.flights.formats.rosbag`.
        motor_order: index in the log of each rotor's motor; by default the vehicle's order.
    """
    column_map = load_column_map(columns) if columns is not None else None
    kind, why = format_of(path)
    if not Path(path).exists():
        why = "no such file"
    elif kind == ROSBAG and Path(path).is_file() and _head(path, unpack=False).startswith(GZIP):
        kind, why = "", f"a {kind} is not read from gzip; unpack it first: gunzip {Path(path).name}"
    elif why == OTHER:
        why = f"is not a log of {', '.join(dict.fromkeys(SUFFIXES.values()))} or {CRAZYFLIE}"
    try:
        if why:
            raise ValueError(why)
        if kind == CSV:
            parts = read_mapped(path, column_map)
        elif kind == ROSBAG:
            parts = read_rosbag(path, topics or {})
        else:
            with readable(path) as file:
                parts = {ULOG: read_ulog, CRAZYFLIE: read_crazyflie, BLACKBOX: read_blackbox}[kind](file.read())
        found = record(path, *parts)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return reordered(found, motor_order) if len(motor_order) else found


def reordered(recording: Recording, motor_order: Sequence[int]) -> Recording:
    """Reorder the motors for the vehicle: rotor i is the log's motor `motor_order[i]`."""
    signals, order = dict(recording.signals), [*motor_order]
    for name in ROTOR_UNITS.keys() & signals.keys():
        signal = signals[name]
        if len({*order}) < len(order) or not {*order} <= {*range(len(signal.axes))}:
            known = ", ".join(signal.axes)
            raise ValueError(f"{recording.name}: motor_order must be of {known}, each at most once, got {order}")
        values = np.asarray(signal.values)[:, order]
        signals[name] = replace(signal, values=values, axes=axes_of(name, len(order)))
    return replace(recording, signals=signals)
