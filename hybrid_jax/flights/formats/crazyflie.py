"""Read logs of the Crazyflie's µSD card deck, version 2 of the binary format, plain or gzip.

The format: byte 0xBC, u16 version, u16 number of event types; of each, u16 id, name, u16 number of variables, each
`group.name(t)` with t of Python's struct; then records of u16 id, u64 µs and values; last CRC-32 of all before.
(bitcraze/crazyflie-firmware, src/deck/drivers/src/usddeck.c.) Numbers are little endian, texts end with a zero byte.

The Crazyflie's pitch, and its rate in `controller`, are counted nose up; the library's nose down.
"""

import array
import re
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hybrid_jax.flights.attitude import from_euler
from hybrid_jax.flights.formats import raw
from hybrid_jax.flights.formats.raw import BATTERY, WXYZ, XYZ, Samples
from hybrid_jax.flights.recording import Recording

MAGIC, VERSION, GRAVITY, FULL = 0xBC, 2, 9.81, 65536.0
_VARIABLE = re.compile(r"(.+)\(([?bBhHiIlLqQefd])\)")
DEGREES, MOTORS = np.pi / 180, "1234"


def _named(pattern: str, axes: Iterable[str]) -> tuple[str, ...]:
    return tuple(pattern.format(axis) for axis in axes)


ANGLES = ("roll", "pitch", "yaw")
# Quantity → where it may stand, the first that a log has counts: variables, and the factors of their values.
SOURCES: dict[str, tuple[tuple[tuple[str, ...], float], ...]] = {
    "position": (
        (_named("stateEstimate.{}", XYZ), 1.0),
        (_named("stateEstimateZ.{}", XYZ), 1e-3),
        (_named("kalman.state{}", "XYZ"), 1.0),
    ),
    "attitude": ((_named("stateEstimate.q{}", WXYZ), 1.0), (_named("kalman.q{}", "0123"), 1.0)),
    "velocity": ((_named("stateEstimate.v{}", XYZ), 1.0), (_named("stateEstimateZ.v{}", XYZ), 1e-3)),
    "rates": (
        (_named("gyro.{}", XYZ), DEGREES),
        (_named("controller.r_{}", ANGLES), 1.0),
        (_named("stateEstimateZ.rate{}", map(str.title, ANGLES)), 1e-3),
    ),
    "specific_force": ((_named("acc.{}", XYZ), GRAVITY),),
    "voltage": ((("pm.vbatMV",), 1e-3), (("pm.vbat",), 1.0)),
    "rotor_speed": ((_named("rpm.m{}", MOTORS), np.pi / 30),),
    "command": ((_named("pwm.m{}_pwm", MOTORS), 1 / FULL), (_named("motor.m{}", MOTORS), 1 / FULL)),
}
AXES = {"attitude": WXYZ, "voltage": BATTERY, "rotor_speed": tuple("0123"), "command": tuple("0123")}
EULER, COMPRESSED = _named("stateEstimate.{}", ANGLES), "stateEstimateZ.quat"
ACCELERATION = _named("stateEstimate.a{}", XYZ)
MIXED = _named("controller.cmd_{}", ("thrust", "roll", "pitch", "yaw"))
# Rows M1 … M4 of thrust, roll / 2, pitch / 2 and yaw (power_distribution_quadrotor.c).
MIXER = np.array([[1, -0.5, 0.5, 1], [1, -0.5, -0.5, -1], [1, 0.5, -0.5, 1], [1, 0.5, 0.5, -1]])
LIMITED = 65535.0  # a jump of a 16-bit number by almost as much is a wrap


class Event(NamedTuple):
    """An event type of a file: its variables and their types."""

    name: str
    variables: tuple[str, ...]
    kinds: str  # of struct

    @property
    def size(self) -> int:
        return struct.calcsize("<Q" + self.kinds)


def read_crazyflie(path: str | Path) -> Recording:
    """Read one log. `command` is the PWM if there is any, else what the mixer asked for, as shares of 65536.

    Raises:
        ValueError: file, variable, time and what to do, in one line.
    """
    content = raw.unpacked(path)
    try:
        events, at = _header(path, content)
    except (struct.error, IndexError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: the header of the µSD log is cut off or damaged; copy the file again") from error
    whole = len(content) > at + 4 and zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little")
    rows, end = _records(content, at, len(content) - 4 * whole, events)
    columns = {name: column for event, found in rows.items() for name, column in _columns(events[event], found)}
    if not columns:
        raise ValueError(f"{path}: holds no records; record the flight again, or copy the file again")
    facts, notes = {"format": "Crazyflie µSD", "vehicle": "multirotor of 4 rotors"}, []
    if not whole:
        last = max(ticks[-1] for ticks, _, _ in columns.values()) - min(ticks[0] for ticks, _, _ in columns.values())
        facts["damage"] = f"its CRC-32 is wrong: cut off or changed; records end at {1e-6 * float(last):.4g} s"
    elif end != len(content) - 4:
        raise ValueError(f"{path}: byte {end}: a record of no known event; was the file written by another firmware?")
    _refuse_wraps(path, columns)
    parts = dict(_parts(columns, notes))
    used = {name for part in parts.values() for name in part.source.split()}
    if rest := sorted({name.split(".")[0] for name in columns.keys() - used}):
        notes.append(f"groups with variables that are not used: {', '.join(rest)}")
    return raw.record(path, parts, 1e-6, notes, facts)


def is_crazyflie(head: bytes) -> bool:
    """Whether a file, by its first bytes, unpacked, is such a log."""
    return len(head) >= 3 and head[0] == MAGIC and head[1:3] == VERSION.to_bytes(2, "little")


def _header(path, content: bytes) -> tuple[dict[int, Event], int]:
    """Event types by id, and where the records begin."""
    if not is_crazyflie(content):
        raise ValueError(f"{path}: is no µSD log of version {VERSION} of a Crazyflie; copy the file again")
    count, at, events = *struct.unpack_from("<H", content, 3), 5, {}
    for _ in range(count):
        (number,) = struct.unpack_from("<H", content, at)
        name, at = _text(content, at + 2)
        (variables,) = struct.unpack_from("<H", content, at)
        at, found = at + 2, []
        for _ in range(variables):
            text, at = _text(content, at)
            match = _VARIABLE.fullmatch(text)
            if match is None:
                raise ValueError(f"{path}: byte {at}: {text[:40]!r} is no variable with its type; copy the file again")
            found.append(match.groups())
        events[number] = Event(name, tuple(name for name, _ in found), "".join(kind for _, kind in found))
    return events, at


def _text(content: bytes, at: int) -> tuple[str, int]:
    end = content.index(b"\0", at) if b"\0" in content[at : at + 256] else len(content)
    return content[at:end].decode("ascii"), end + 1 if end < len(content) else len(content)


def _records(content: bytes, at: int, end: int, events: Mapping[int, Event]) -> tuple[dict[int, np.ndarray], int]:
    """The bytes of all whole records by event type, one row each, and where they end."""
    sizes = {number.to_bytes(2, "little"): event.size for number, event in events.items()}
    starts = {key: array.array("q") for key in sizes}
    while at + 2 <= end and (size := sizes.get(key := content[at : at + 2])) and at + 2 + size <= end:
        starts[key].append(at + 2)
        at += 2 + size
    data = np.frombuffer(content, np.uint8)
    found = {}
    for key, places in starts.items():
        if places:
            rows = found[int.from_bytes(key, "little")] = np.empty((len(places), sizes[key]), np.uint8)
            for column in range(sizes[key]):  # one by one, as an index of every byte would take eight times the log
                rows[:, column] = data[np.asarray(places) + column]
    return found, at


def _columns(event: Event, rows: np.ndarray) -> Iterator[tuple[str, tuple[np.ndarray, np.ndarray, str]]]:
    """Variable → its ticks [µs], values and type."""
    sizes = [8, *(struct.calcsize("<" + kind) for kind in event.kinds)]
    ends = np.cumsum([0, *sizes])
    kinds = ["<u8", *(f"<{_numpy(kind)}" for kind in event.kinds)]
    spans = zip(ends[:-1], ends[1:], kinds, strict=True)
    cut = [np.ascontiguousarray(rows[:, start:end]).view(kind)[:, 0] for start, end, kind in spans]
    ticks = cut[0].astype(np.int64)
    for name, kind, values in zip(event.variables, event.kinds, cut[1:], strict=True):
        yield name, (ticks, values.astype(float), kind)


def _numpy(kind: str) -> str:
    size = struct.calcsize("<" + kind)
    return f"{'f' if kind in 'efd' else 'u' if kind.isupper() or kind == '?' else 'i'}{size}"


def _refuse_wraps(path, columns) -> None:
    for name, (ticks, values, kind) in columns.items():
        jumps = np.flatnonzero(np.abs(np.diff(values)) > 0.98 * LIMITED) + 1 if kind == "h" else ()
        for row in jumps[:1]:
            at, numbers = 1e-6 * float(ticks[row] - ticks[0]), f"{values[row - 1]:g} to {values[row]:g}"
            raise ValueError(f"{path}: {name}: goes from {numbers} at {at:.4g} s: 16 bits wrapped; log it as a float")


def _parts(columns, notes: list[str]) -> Iterator[tuple[str, Samples]]:
    for quantity, places in SOURCES.items():
        for names, factor in places:
            if {*names} <= {*columns}:
                values = _stacked(columns, names) * factor
                if names[0] in ("controller.r_roll", "stateEstimateZ.rateRoll"):
                    values = values * [1, -1, 1]
                yield quantity, Samples(columns[names[0]][0], values, AXES.get(quantity, XYZ), " ".join(names))
                break
    yield from _derived(columns, notes)


def _derived(columns, notes: list[str]) -> Iterator[tuple[str, Samples]]:
    """Attitude, and what only follows from other variables."""
    if any({*names} <= {*columns} for names, _ in SOURCES["attitude"]):
        pass  # as quaternions, above
    elif COMPRESSED in columns:
        ticks, values, _ = columns[COMPRESSED]
        yield "attitude", Samples(ticks, unpack_attitude(values), WXYZ, COMPRESSED)
    elif {*EULER} <= {*columns}:
        angles = _stacked(columns, EULER) * DEGREES * [1, -1, 1]
        yield "attitude", Samples(columns[EULER[0]][0], from_euler(angles), WXYZ, " ".join(EULER))
    elif {EULER[0], EULER[2], *ACCELERATION} <= {*columns}:
        roll, yaw = (columns[name][1] * DEGREES for name in (EULER[0], EULER[2]))
        x, y, z = (_stacked(columns, ACCELERATION) + np.array([0, 0, 1])).T
        pitch = np.arctan2(np.cos(yaw) * x + np.sin(yaw) * y, z)
        notes.append("pitch is not logged: the one with which stateEstimate.a* and gravity are along the body's z")
        values = from_euler(np.stack([roll, pitch, yaw], axis=1))
        yield "attitude", Samples(columns[EULER[0]][0], values, WXYZ, f"{EULER[0]} {EULER[2]} {' '.join(ACCELERATION)}")
    force = [name for name in ("acc.x", "controller.accelz") if name in columns]
    if force == ["controller.accelz"]:
        values = _stacked(columns, force) * GRAVITY
        yield "specific_force", Samples(columns[force[0]][0], values, ("z",), force[0])
    elif not force and {*ACCELERATION} <= {*columns}:
        felt = np.linalg.norm(_stacked(columns, ACCELERATION) + np.array([0, 0, 1]), axis=1, keepdims=True) * GRAVITY
        notes.append("specific force along z: the length of stateEstimate.a* with gravity; no accelerometer is logged")
        yield "specific_force", Samples(columns[ACCELERATION[0]][0], felt, ("z",), " ".join(ACCELERATION))
    if {*MIXED} <= {*columns} and not {"motor.m1", "pwm.m1_pwm"} & {*columns}:
        commands = np.clip(_stacked(columns, MIXED) @ MIXER.T, 0, LIMITED) / FULL
        notes.append("commands: the mixer's, of controller.cmd_*, as neither motor.m* nor pwm.m*_pwm is logged")
        yield "command", Samples(columns[MIXED[0]][0], commands, tuple("0123"), " ".join(MIXED))


def unpack_attitude(numbers: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of 32 bits: which of x, y, z, w is largest; of each other a sign and nine bits (quatcompress.h)."""
    bits = numbers.astype(np.int64)
    largest, q = bits >> 30, np.zeros((len(bits), 4))
    for i in (3, 2, 1, 0):
        other = i != largest
        q[other, i] = (np.where(bits & 512, -1, 1) * (bits & 511) / 511 / np.sqrt(2))[other]
        bits = np.where(other, bits >> 10, bits)
    q[np.arange(len(q)), largest] = np.sqrt(np.maximum(1 - (q**2).sum(axis=1), 0))
    return np.roll(q, 1, axis=1)


def _stacked(columns, names) -> np.ndarray:
    """Variables of one event type side by side."""
    return np.stack([columns[name][1] for name in names], axis=1)
