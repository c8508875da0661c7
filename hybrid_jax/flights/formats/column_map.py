"""Read any CSV log by a TOML file that describes its columns. You should state every unit and frame; none is assumed.

frames = {world = "NED", body = "FRD", velocity = "world"}      # or "ENU" (any world with z up), "FLU", "body"
time = {columns = ["timestamp"], unit = "us"}                   # s, ms, us, ns
position = {columns = ["x", "y", "z"], unit = "mm"}             # m, cm, mm
attitude = {columns = ["q0", "q1", "q2", "q3"], unit = "wxyz"}  # body → world; wxyz, xyzw; roll, pitch, yaw: rad, deg
velocity = {columns = ["vx", "vy", "vz"], unit = "m/s"}         # m/s, cm/s, mm/s
body_rates = {columns = ["p", "q", "r"], unit = "deg/s"}        # rad/s, deg/s
specific_force = {columns = ["ax", "ay", "az"], unit = "g"}     # of the body, as an accelerometer measures it; m/s², g
voltage = {columns = ["vbat"], unit = "V"}                      # V, mV
motors = {columns = ["m3", "m1", "m4", "m2"], unit = "rpm"}     # rad/s, rpm, rev/s, or commands; in the vehicle's order
format = {delimiter = ";", decimal = ","}                       # optional, by default "," and "."

You can leave out all but frames and time; training on states needs position, attitude, velocity, body_rates and motors.
The unit of commands is share (0 … 1), percent, pwm (1000 … 2000 µs), 16bit (0 … 65535) or dshot (48 … 2047). For any
other scale it is command, with polynomial = [c0, c1, …]: rad/s = c0 + c1 command + c2 command² …
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hybrid_jax import vehicle
from hybrid_jax.flights.attitude import Frames, from_euler
from hybrid_jax.flights.formats import raw
from hybrid_jax.flights.formats.csv import header_of, read_table

SCALES = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "position": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "attitude": {"wxyz": 1.0, "xyzw": 1.0, "rad": 1.0, "deg": math.pi / 180},
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "body_rates": {"rad/s": 1.0, "deg/s": math.pi / 180},
    "specific_force": {"m/s²": 1.0, "m/s^2": 1.0, "g": 9.81},
    "voltage": {"V": 1.0, "mV": 1e-3},
    "motors": {"rad/s": 1.0, "rpm": math.pi / 30, "rev/s": 2 * math.pi, "command": 1.0}
    | {"share": 1.0, "percent": 1e-2, "pwm": 1e-3, "16bit": 1 / 65535, "dshot": 1 / 1999},
}
REST = {"pwm": 1000.0, "dshot": 48.0}  # values of motors at rest
DISARMED = 0.8  # of the value at rest
SHARES = ("share", "percent", "pwm", "16bit", "dshot")  # units of commands
COUNTS = {"time": 1, "position": 3, "velocity": 3, "body_rates": 3, "specific_force": 3, "voltage": 1}


@dataclass(frozen=True)
class Columns:
    """The columns of one quantity, their unit, and a polynomial from motor commands to rotor speeds [rad/s]."""

    columns: tuple[str, ...]
    unit: str
    polynomial: tuple[float, ...] = ()


@dataclass(frozen=True)
class Format:
    """The field delimiter and the decimal mark (a point or a comma) of a file."""

    delimiter: str = ","
    decimal: str = "."

    def __post_init__(self):
        if self.decimal not in (".", ",") or self.decimal == self.delimiter:
            raise ValueError(f'decimal must be "." or "," and not the delimiter, got {self.decimal!r}')
        if not isinstance(self.delimiter, str) or len(self.delimiter) != 1 or self.delimiter in "\r\n":
            raise ValueError(f"delimiter must be one character, got {self.delimiter!r}")


@dataclass(frozen=True)
class ColumnMap:
    """The tables of the TOML file, with a quantity for each key of `SCALES`."""

    frames: Frames
    time: Columns
    position: Columns | None = None
    attitude: Columns | None = None
    velocity: Columns | None = None
    body_rates: Columns | None = None
    specific_force: Columns | None = None
    voltage: Columns | None = None
    motors: Columns | None = None
    format: Format = Format()

    def __post_init__(self):
        for name, stated in self.quantities.items():
            _check(name, stated)
        for column in self.names:
            if self.names.count(column) > 1:
                raise ValueError(f"columns: {column!r} is named twice")

    @property
    def quantities(self) -> dict[str, Columns]:
        return {name: getattr(self, name) for name in SCALES if getattr(self, name) is not None}

    @property
    def names(self) -> list[str]:
        return [column for stated in self.quantities.values() for column in stated.columns]


def load_column_map(path: str | Path) -> ColumnMap:
    tables, parts = vehicle.read_tables(path), {}
    vehicle.require_known(str(path), tables, [*ColumnMap.__dataclass_fields__])
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise ValueError(f"{path}: [{name}]: must be a table, got {table!r}")
        kind = {"frames": Frames, "format": Format}.get(name, Columns)
        parts[name] = vehicle.from_table(kind, table, f"{path}: [{name}]")
    return vehicle.from_table(ColumnMap, parts, str(path))


def library_map(path: str | Path) -> ColumnMap:
    """Return the map of a file with the library's columns t (or time), px … wz, u0 …"""
    names, motors = header_of(path), vehicle.input_names(vehicle.MOST_ROTORS)
    count = max([vehicle.FEWEST_ROTORS, *(i + 1 for i, name in enumerate(motors) if name in names)])
    return ColumnMap(
        Frames("ENU", "FLU", "world"),
        Columns(("time" if "time" in names and "t" not in names else "t",), "s"),
        position=Columns(vehicle.STATE_NAMES[vehicle.POSITION], "m"),
        attitude=Columns(vehicle.STATE_NAMES[vehicle.QUATERNION], "wxyz"),
        velocity=Columns(vehicle.STATE_NAMES[vehicle.VELOCITY], "m/s"),
        body_rates=Columns(vehicle.STATE_NAMES[vehicle.BODY_RATES], "rad/s"),
        motors=Columns(motors[:count], "rad/s"),
    )


def read_mapped(path: str | Path, column_map: ColumnMap | None) -> raw.Parts:
    """Read the mapped quantities of a CSV file. Each has the times of the rows that contain it."""
    column_map = column_map or library_map(path)
    form, stated, frames = column_map.format, column_map.quantities, column_map.frames
    table, notes = read_table(path, column_map.names, delimiter=form.delimiter, decimal=form.decimal)
    named = dict(zip(column_map.names, table.T, strict=True))
    clock, found = stated.pop("time"), {}
    t = named[clock.columns[0]] * SCALES["time"][clock.unit]
    for name, each in stated.items():
        values, source = np.stack([named[column] for column in each.columns], axis=1), " ".join(each.columns)
        given = np.isfinite(t) & np.isfinite(values).all(axis=1)
        partly = f"columns {source}: {given.sum()} of {len(t)} rows contain {name}"
        notes += () if given.all() else (partly,)
        values = of_unit(values[given], each.unit) if name == "motors" else values[given] * SCALES[name][each.unit]
        if each.polynomial:
            values = np.polynomial.polynomial.polyval(values, each.polynomial)
        if name == "attitude":
            values = _attitude(values, each)
        commands = each.unit in SHARES and not each.polynomial
        quantity = {"body_rates": "rates", "motors": "command" if commands else "rotor_speed"}.get(name, name)
        quantity = "body_velocity" if name == "velocity" and frames.velocity == "body" else quantity
        found[quantity] = raw.Samples(t[given], values, f"columns {source}")
    return raw.turned(found, frames.world, frames.body), 1.0, notes, {"format": "CSV"}


def of_unit(motors: Float[np.ndarray, "n m"], unit: str) -> Float[np.ndarray, "n m"]:
    """Convert motors to rad/s or to shares of 0 … 1; values slightly below rest, for example 900 µs, become 0."""
    rest = REST.get(unit, 0.0)
    disarmed = (motors == 0) | ((motors >= DISARMED * rest) & (motors < rest))
    return np.where(disarmed, 0.0, motors - rest) * SCALES["motors"][unit]


def _attitude(values: Float[np.ndarray, "n k"], stated: Columns) -> Float[np.ndarray, "n 4"]:
    fields = " ".join(stated.columns)
    if len(stated.columns) == 3:
        # Yaw may be counted beyond a turn, tilt may not.
        if (np.abs(values[:, :2]) > 2 * math.pi).any():
            advice = 'roll or pitch above 2π; are the angles degrees? set [attitude] unit = "deg"'
            raise ValueError(f"field {fields}: {advice}")
        return from_euler(values)
    return np.roll(values, 1, axis=1) if stated.unit == "xyzw" else values


def _check(name: str, stated: Columns) -> None:
    if stated.unit not in tuple(SCALES[name]):
        raise ValueError(f"[{name}]: unit must be one of {', '.join(SCALES[name])}, got {stated.unit!r}")
    columns, count = stated.columns, COUNTS.get(name, 4 if stated.unit in ("wxyz", "xyzw") else 3)
    if name == "motors" and isinstance(columns, tuple):
        count = min(max(len(columns), vehicle.FEWEST_ROTORS), vehicle.MOST_ROTORS)
    named = isinstance(columns, tuple) and all(isinstance(column, str) for column in columns)
    if not named or len(columns) != count:
        raise ValueError(f"[{name}]: columns must be a list of {count} names for unit {stated.unit}, got {columns!r}")
    given = stated.polynomial
    numbers = isinstance(given, tuple) and all(isinstance(c, int | float) and math.isfinite(c) for c in given)
    needed = stated.unit == "command"
    if not numbers or bool(given) < needed or (given and not (needed or stated.unit in SHARES)):
        what = "polynomial must be numbers c0, c1, … of a unit of commands"
        raise ValueError(f"[{name}]: {what}, got {given!r} for {stated.unit}")
