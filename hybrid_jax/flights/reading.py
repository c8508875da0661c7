"""Read any log into a `Recording`: the format is told by the file's first bytes, and by its suffix."""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybrid_jax.flights.formats.blackbox import read_blackbox
from hybrid_jax.flights.formats.column_map import ColumnMap, load_column_map, record_mapped
from hybrid_jax.flights.formats.crazyflie import is_crazyflie, read_crazyflie
from hybrid_jax.flights.formats.csv import notes_on_end, read_csv
from hybrid_jax.flights.formats.raw import WXYZ, XYZ, is_packed, opened
from hybrid_jax.flights.formats.rosbag import read_rosbag
from hybrid_jax.flights.formats.ulog import read_ulog
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.recording import ROTOR_UNITS, Recording, Signal
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY

CSV, ULOG, CRAZYFLIE, ROSBAG, BLACKBOX = "CSV", "PX4 ULog", "Crazyflie µSD", "rosbag", "Betaflight blackbox"
SUFFIXES = {".csv": CSV, ".csv.gz": CSV, ".ulg": ULOG, ".mcap": ROSBAG, ".db3": ROSBAG, ".bag": ROSBAG}
SUFFIXES |= {".bbl": BLACKBOX, ".bfl": BLACKBOX}
MAGICS = {b"ULog": ULOG, b"\x89MCAP": ROSBAG, b"SQLite format 3": ROSBAG, b"#ROSBAG": ROSBAG}
MAGICS |= {b"H Product:Blackbox": BLACKBOX}
BAG = "metadata.yaml"  # makes a folder one recording of ROS 2


def format_of(path: str | Path) -> str:
    """The format of a file or folder, by its first bytes, else by its suffix; empty if it is none that is read."""
    path = Path(path)
    if path.is_dir():
        return ROSBAG if (path / BAG).is_file() else ""
    try:
        with opened(path) as file:
            head = file.read(32)
    except (OSError, EOFError, zlib.error):
        head = b""  # the reader that the suffix asks for says what is wrong
    if is_crazyflie(head):
        return CRAZYFLIE
    found = [kind for magic, kind in MAGICS.items() if head.startswith(magic)]
    named = [kind for suffix, kind in SUFFIXES.items() if path.name.lower().endswith(suffix)]
    return (found or named or [""])[0]


def find_logs(folder: str | Path) -> tuple[list[Path], dict[Path, str]]:
    """The logs of a folder in the order of their names, and its other files, each with why it is left.

    Hidden files are passed over.

    Raises:
        ValueError: there is no such folder.
    """
    folder, logs, left = Path(folder), [], {}
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
    if format_of(folder):
        return [folder], {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if format_of(path):
            logs.append(path)
        elif path.is_dir():
            left[path] = "a folder; give it by itself"
        else:
            left[path] = "empty" if not path.stat().st_size else "no format that is read"
    return logs, left


def read_recording(
    path: str | Path,
    columns: ColumnMap | str | Path | None = None,
    topics: Mapping[str, str] | None = None,
    motor_order: Sequence[int] = (),
) -> Recording:
    """Read one log of any format of `format_of`.

    Args:
        columns: column map (or its TOML file) of CSV logs; by default they have the library's columns and units.
        topics: for ROS bags, the topics of some quantities: see `hybrid_jax.flights.formats.rosbag`.
        motor_order: which motor of the log, from 0, each rotor of the vehicle is; by default they are in one order.

    Raises:
        ValueError: file, topic or column, time and what was expected, in one line.
    """
    kind = format_of(path)
    if not Path(path).exists():
        raise ValueError(f"{path}: no such file")
    if kind == CSV:
        columns = load_column_map(columns) if isinstance(columns, str | Path) else columns
        found = recording_of(read_csv(path)) if columns is None else record_mapped(path, columns)
        found = replace(found, notes=(*found.notes, *notes_on_end(path)))
    elif kind in (ROSBAG, BLACKBOX) and Path(path).is_file() and is_packed(path):
        raise ValueError(f"{path}: a {kind} is not read from gzip; unpack it first: gunzip {Path(path).name}")
    elif kind == ROSBAG:
        found = read_rosbag(path, topics or {})
    elif kind:
        found = {ULOG: read_ulog, CRAZYFLIE: read_crazyflie, BLACKBOX: read_blackbox}[kind](path)
    else:
        raise ValueError(f"{path}: is none of {', '.join(dict.fromkeys(SUFFIXES.values()))}, {CRAZYFLIE}")
    return reordered(found, motor_order) if len(motor_order) else found


def recording_of(log: FlightLog) -> Recording:
    """A flight as a recording of its columns."""
    states = {"position": POSITION, "attitude": QUATERNION, "velocity": VELOCITY, "rates": BODY_RATES}
    t, signals = log.t - log.t[0], {}
    for name, part in states.items():
        signals[name] = Signal(t, log.x[:, part], WXYZ if name == "attitude" else XYZ, f"columns of {name}")
    axes = tuple(map(str, range(log.u.shape[1])))
    signals["rotor_speed"] = Signal(t, log.u, axes, "columns of the motors")
    return Recording(log.name, signals, facts={"format": CSV})


def reordered(recording: Recording, motor_order: Sequence[int]) -> Recording:
    """The recording with its motors in the vehicle's order: rotor i is the log's motor `motor_order[i]`.

    Raises:
        ValueError: a motor is named twice, or the log has no such motor.
    """
    signals, order = dict(recording.signals), [*motor_order]
    for name in ROTOR_UNITS.keys() & signals.keys():
        signal = signals[name]
        if len({*order}) < len(order) or not {*order} <= {*range(len(signal.axes))}:
            wanted = ", ".join(signal.axes)
            raise ValueError(f"{recording.name}: --motor-order must be of {wanted}, each at most once, got {order}")
        axes = tuple(map(str, range(len(order))))
        signals[name] = replace(signal, values=np.asarray(signal.values)[:, order], axes=axes)
    return replace(recording, signals=signals)
