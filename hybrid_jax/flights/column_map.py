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

import numpy as np
from jaxtyping import Float

from hybrid_jax.flights.attitude import Frames, from_euler, to_library
from hybrid_jax.flights.flight_csv import flight_log, read_table
from hybrid_jax.flights.log import FlightLog, wrong_norms
from hybrid_jax.vehicle import FEWEST_ROTORS, MOST_ROTORS, from_table, read_tables, require_known

SCALES = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "position": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "attitude": {"wxyz": 1.0, "xyzw": 1.0, "rad": 1.0, "deg": math.pi / 180},
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "body_rates": {"rad/s": 1.0, "deg/s": math.pi / 180},
    "motors": {"rad/s": 1.0, "rpm": math.pi / 30, "rev/s": 2 * math.pi, "command": 1.0},
}
COUNTS = {"time": 1, "position": 3, "velocity": 3, "body_rates": 3}


@dataclass(frozen=True)
class Columns:
    """The columns of one quantity and their unit; for motor commands also the coefficients c0, c1, … of their map."""

    columns: tuple[str, ...]
    unit: str
    polynomial: tuple[float, ...] = ()


@dataclass(frozen=True)
class Format:
    """How the numbers stand in the file."""

    delimiter: str = ","

    def __post_init__(self):
        if not isinstance(self.delimiter, str) or len(self.delimiter) != 1 or self.delimiter in "\r\n":
            raise ValueError(f"delimiter must be one character, got {self.delimiter!r}")


@dataclass(frozen=True)
class ColumnMap:
    """The meaning of the columns of a CSV log: the tables of the TOML file, with a quantity for each key of `SCALES`.

    Raises:
        ValueError: the table, the key and what was expected, in one line.
    """

    frames: Frames
    time: Columns
    position: Columns
    attitude: Columns
    velocity: Columns
    body_rates: Columns
    motors: Columns
    format: Format = Format()

    def __post_init__(self):
        for name, stated in self.quantities.items():
            _check(name, stated)
        for column in self.names:
            if self.names.count(column) > 1:
                raise ValueError(f"columns: {column!r} is named twice")

    @property
    def quantities(self) -> dict[str, Columns]:
        """The columns of each quantity, in the order of `SCALES`."""
        return {name: getattr(self, name) for name in SCALES}

    @property
    def names(self) -> list[str]:
        """All columns, in the order of `SCALES`."""
        return [column for stated in self.quantities.values() for column in stated.columns]


def load_column_map(path: str | Path) -> ColumnMap:
    """Read a column map.

    Raises:
        ValueError: file, table, key and what was expected, in one line.
    """
    tables, parts = read_tables(path), {}
    require_known(str(path), tables, [*ColumnMap.__dataclass_fields__])
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise ValueError(f"{path}: [{name}]: must be a table, got {table!r}")
        kind = {"frames": Frames, "format": Format}.get(name, Columns)
        parts[name] = from_table(kind, table, f"{path}: [{name}]")
    return from_table(ColumnMap, parts, str(path))


def read_mapped(path: str | Path, column_map: ColumnMap) -> FlightLog:
    """Read one flight of a CSV file, plain or gzip, into the library's units and frames.

    Raises:
        ValueError: file, row, field and what to do, in one line.
    """
    table = read_table(path, column_map.names, delimiter=column_map.format.delimiter)
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
        # Yaw may be counted over turns, tilt may not.
        for row in np.flatnonzero((np.abs(values[:, :2]) > 2 * math.pi).any(axis=1))[:1]:
            advice = 'roll or pitch above 2π; are the angles degrees? set [attitude] unit = "deg"'
            raise ValueError(f"{origin}: row {row + 2}, field {fields}: {advice}")
        return from_euler(values)
    q = np.roll(values, 1, axis=1) if stated.unit == "xyzw" else values
    for row, norm in wrong_norms(q):
        advice = "cut out samples without an attitude, or name the four quaternion columns"
        raise ValueError(f"{origin}: row {row + 2}, field {fields}: norm is {norm:.4g}, not 1; {advice}")
    return q


def _check(name: str, stated: Columns) -> None:
    if stated.unit not in tuple(SCALES[name]):
        raise ValueError(f"[{name}]: unit must be one of {', '.join(SCALES[name])}, got {stated.unit!r}")
    columns, count = stated.columns, COUNTS.get(name, 4 if stated.unit in ("wxyz", "xyzw") else 3)
    if name == "motors" and isinstance(columns, tuple):
        count = min(max(len(columns), FEWEST_ROTORS), MOST_ROTORS)
    named = isinstance(columns, tuple) and all(isinstance(column, str) for column in columns)
    if not named or len(columns) != count:
        raise ValueError(f"[{name}]: columns must be a list of {count} names for unit {stated.unit}, got {columns!r}")
    given = stated.polynomial
    numbers = isinstance(given, tuple) and all(isinstance(c, int | float) and math.isfinite(c) for c in given)
    if not numbers or bool(given) != (stated.unit == "command"):
        what = "polynomial must be numbers c0, c1, … if and only if the unit is command"
        raise ValueError(f"[{name}]: {what}, got {given!r} for {stated.unit}")
