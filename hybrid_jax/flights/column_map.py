"""Read any CSV log through a TOML file that states the meaning of its columns; no unit or frame is assumed.

frames = {world = "NED", body = "FRD", velocity = "world"}      # or "ENU" (any world with z up), "FLU", "body"
time = {columns = ["timestamp"], unit = "us"}                   # s, ms, us, ns
position = {columns = ["x", "y", "z"], unit = "mm"}             # m, cm, mm
attitude = {columns = ["q0", "q1", "q2", "q3"], unit = "wxyz"}  # body → world; wxyz, xyzw; roll, pitch, yaw: rad, deg
velocity = {columns = ["vx", "vy", "vz"], unit = "m/s"}         # m/s, cm/s, mm/s
body_rates = {columns = ["p", "q", "r"], unit = "deg/s"}        # rad/s, deg/s
motors = {columns = ["m3", "m1", "m4", "m2"], unit = "rpm"}     # rad/s, rpm, rev/s, command; in the vehicle's order
format = {delimiter = ";"}                                      # optional, by default a comma

Motors in unit "command" need polynomial = [c0, c1, …]: rad/s = c0 + c1 command + c2 command² …
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hybrid_jax.flights.attitude import Frames, from_euler, to_library
from hybrid_jax.flights.flight_csv import MAX_ROWS, flight_log, read_table
from hybrid_jax.flights.log import NORM_TOLERANCE, FlightLog
from hybrid_jax.vehicle import read_tables

SCALES = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "position": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "attitude": {"wxyz": 1.0, "xyzw": 1.0, "rad": 1.0, "deg": math.pi / 180},
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "body_rates": {"rad/s": 1.0, "deg/s": math.pi / 180},
    "motors": {"rad/s": 1.0, "rpm": math.pi / 30, "rev/s": 2 * math.pi, "command": 1.0},
}
COUNTS = {"time": 1, "position": 3, "velocity": 3, "body_rates": 3, "motors": 4}


@dataclass(frozen=True)
class Columns:
    """The columns of one quantity and their unit; for motor commands also the coefficients c0, c1, … of their map."""

    columns: tuple[str, ...]
    unit: str
    polynomial: tuple[float, ...] = ()


@dataclass(frozen=True)
class ColumnMap:
    """The meaning of the columns of a CSV log; `quantities` has one entry for each key of `SCALES`.

    Raises:
        ValueError: the table, the key and what was expected, in one line.
    """

    frames: Frames
    quantities: dict[str, Columns]
    delimiter: str = ","

    def __post_init__(self):
        for name, scales in SCALES.items():
            if name not in self.quantities:
                raise ValueError(f"[{name}]: is missing; give its columns and unit")
            _check(name, self.quantities[name], scales)
        for name, stated in self.quantities.items():
            for column in stated.columns:
                if self.names.count(column) > 1:
                    raise ValueError(f"[{name}]: column {column!r} is named twice")
        if not isinstance(self.delimiter, str) or len(self.delimiter) != 1 or self.delimiter in "\r\n":
            raise ValueError(f"[format]: delimiter must be one character, got {self.delimiter!r}")

    @property
    def names(self) -> list[str]:
        """All columns, in the order of `SCALES`."""
        return [column for name in SCALES for column in self.quantities[name].columns]


def load_column_map(path: str | Path) -> ColumnMap:
    """Read a column map.

    Raises:
        ValueError: file, table, key and what was expected, in one line.
    """
    tables = read_tables(path)
    try:
        return _column_map(tables)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    except TypeError as error:
        raise ValueError(f"{path}: a value of the wrong type: {error}") from error


def read_mapped(path: str | Path, column_map: ColumnMap, *, max_rows: int = MAX_ROWS) -> FlightLog:
    """Read one flight of a CSV file, plain or gzip, into the library's units and frames.

    Raises:
        ValueError: file, row, field and what to do, in one line.
    """
    table = read_table(path, column_map.names, delimiter=column_map.delimiter, max_rows=max_rows)
    stated, parts, begin = column_map.quantities, {}, 0
    for name, scales in SCALES.items():
        end = begin + len(stated[name].columns)
        parts[name], begin = table[:, begin:end] * scales[stated[name].unit], end
    q = _attitude(parts["attitude"], stated["attitude"], path)
    motors, polynomial = parts["motors"], stated["motors"].polynomial
    u = np.polynomial.polynomial.polyval(motors, polynomial) if polynomial else motors
    x = to_library(parts["position"], q, parts["velocity"], parts["body_rates"], column_map.frames)
    return flight_log(path, np.concatenate([parts["time"], x, u], axis=1))


def _attitude(values: Float[np.ndarray, "n k"], stated: Columns, origin: str | Path) -> Float[np.ndarray, "n 4"]:
    fields = " ".join(stated.columns)
    if len(stated.columns) == 3:
        row = int(np.abs(values).max(axis=1).argmax())
        # Yaw may be counted over turns, tilt may not.
        if np.abs(values[:, :2]).max() > 2 * math.pi:
            raise ValueError(
                f"{origin}: row {row + 2}, field {fields}: roll or pitch above 2π; "
                'are the angles degrees? set [attitude] unit = "deg"'
            )
        return from_euler(values)
    q = np.roll(values, 1, axis=1) if stated.unit == "xyzw" else values
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(q, axis=1)
    for row in np.flatnonzero(np.abs(norm - 1) > NORM_TOLERANCE)[:1]:
        raise ValueError(
            f"{origin}: row {row + 2}, field {fields}: norm is {norm[row]:.4g}, not 1; "
            "cut out samples without an attitude, or name the four quaternion columns"
        )
    return q


def _column_map(tables: dict[str, Any]) -> ColumnMap:
    known = {"frames": (("world", "body", "velocity"), ())}
    known |= dict.fromkeys(SCALES, (("columns", "unit"), ("polynomial",))) | {"format": ((), ("delimiter",))}
    for name, table in {"frames": {}, **tables}.items():
        if name not in known:
            raise ValueError(f"[{name}]: no such table; known are {', '.join(known)}")
        if not isinstance(table, dict):
            raise ValueError(f"[{name}]: must be a table, got {table!r}")
        needed, allowed = known[name]
        for key in needed:
            if key not in table:
                raise ValueError(f"[{name}]: {key} is missing")
        for key in table:
            if key not in needed + allowed:
                raise ValueError(f"[{name}]: {key}: no such key; known are {', '.join(needed + allowed)}")
    quantities = {}
    for name in filter(tables.__contains__, SCALES):
        lists = {key: tables[name].get(key, []) for key in ("columns", "polynomial")}
        if not all(isinstance(value, list) for value in lists.values()):
            raise ValueError(f"[{name}]: columns and polynomial must be lists, got {lists}")
        quantities[name] = Columns(tuple(lists["columns"]), tables[name]["unit"], tuple(lists["polynomial"]))
    return ColumnMap(Frames(**tables["frames"]), quantities, tables.get("format", {}).get("delimiter", ","))


def _check(name: str, stated: Columns, scales: dict[str, float]) -> None:
    if not isinstance(stated.unit, str) or stated.unit not in scales:
        raise ValueError(f"[{name}]: unit must be one of {', '.join(scales)}, got {stated.unit!r}")
    count = COUNTS.get(name, 4 if stated.unit in ("wxyz", "xyzw") else 3)
    if len(stated.columns) != count or not all(isinstance(column, str) for column in stated.columns):
        raise ValueError(f"[{name}]: columns must be {count} names for unit {stated.unit}, got {list(stated.columns)}")
    numbers = [isinstance(c, int | float) and math.isfinite(c) for c in stated.polynomial]
    if bool(numbers) != (stated.unit == "command") or not all(numbers):
        raise ValueError(
            f"[{name}]: polynomial must be numbers c0, c1, … if and only if the unit is command, "
            f"got {list(stated.polynomial)} for {stated.unit}"
        )
