"""Read logs of the Crazyflie's µSD card deck, version 2 of the binary format, plain or gzip.

The format: byte 0xBC, u16 version, u16 number of event types; for each, u16 id, name, u16 number of variables, each
`group.name(t)` with t of Python's struct; then records of u16 id, u64 µs and values; finally the CRC-32 of all these.
(bitcraze/crazyflie-firmware, src/deck/drivers/src/usddeck.c.) Numbers are little endian, texts end with a zero byte.

The Crazyflie's pitch, and its rate in `controller`, are positive nose up; the library's nose down.
"""

import array
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from hybrid_jax.flights.attitude import from_euler
from hybrid_jax.flights.formats.raw import Parts, Samples

MAGIC, VERSION, GRAVITY, FULL = 0xBC, 2, 9.81, 65536.0
_VARIABLE = re.compile(r"(.+)\(([?bBhHiIlLqQefd])\)")
KINDS = str.maketrans("?lL", "BiI")  # from struct to NumPy: the same sizes
DEGREES, MOTORS = np.pi / 180, "1234"


def _named(pattern: str, axes: Iterable[str]) -> tuple[str, ...]:
    return tuple(pattern.format(axis) for axis in axes)


def _without_pitch(v: np.ndarray) -> np.ndarray:
    """Compute attitudes with z along acceleration plus gravity, from roll, yaw [deg] and acceleration [g, world]."""
    roll, yaw, x, y, z = (v * [DEGREES, DEGREES, 1, 1, 1] + [0, 0, 0, 0, 1]).T
    return from_euler(np.stack([roll, np.arctan2(np.cos(yaw) * x + np.sin(yaw) * y, z), yaw], axis=1))


def unpack_attitude(numbers: np.ndarray) -> np.ndarray:
    """Unpack (w, x, y, z) from 32 bits: the index of the largest, then sign and nine bits each (quatcompress.h)."""
    bits = numbers.astype(np.int64)
    largest, q = bits >> 30, np.zeros((len(bits), 4))
    for i in (3, 2, 1, 0):
        other = i != largest
        q[other, i] = (np.where(bits & 512, -1, 1) * (bits & 511) / 511 / np.sqrt(2))[other]
        bits = np.where(other, bits >> 10, bits)
    q[np.arange(len(q)), largest] = np.sqrt(np.maximum(1 - (q**2).sum(axis=1), 0))
    return np.roll(q, 1, axis=1)


NOSE = np.array([1.0, -1.0, 1.0])  # signs of (roll, pitch, yaw) if pitch is positive nose up
# Rows M1 … M4 of thrust, roll / 2, pitch / 2 and yaw (power_distribution_quadrotor.c).
MIXER = np.array([[1, -0.5, 0.5, 1], [1, -0.5, -0.5, -1], [1, 0.5, -0.5, 1], [1, 0.5, 0.5, -1]])
LIMITED = 65535.0  # a jump of a 16-bit number by almost as much is a wrap
UP = np.array([0.0, 0.0, 1.0])  # g
ANGLES = ("roll", "pitch", "yaw")
ACCELERATION = _named("stateEstimate.a{}", "xyz")
NO_PITCH = "pitch is not logged: computed so that stateEstimate.a* and gravity are along the body's z"
NO_FORCE = "no accelerometer is logged: specific force along z is the norm of stateEstimate.a* with gravity"
NO_MOTOR = "neither motor.m* nor pwm.m*_pwm is logged: commands are the mixer's output for controller.cmd_*"
# Quantity → its possible sources, of which the first in a log is used: variables, a factor or a function, and a note.
Conversion = float | np.ndarray | Callable[[np.ndarray], np.ndarray]
SOURCES: dict[str, list[tuple[tuple[str, ...], Conversion, str]]] = {
    "position": [
        (_named("stateEstimate.{}", "xyz"), 1.0, ""),
        (_named("stateEstimateZ.{}", "xyz"), 1e-3, ""),
        (_named("kalman.state{}", "XYZ"), 1.0, ""),
    ],
    "attitude": [
        (_named("stateEstimate.q{}", "wxyz"), 1.0, ""),
        (_named("kalman.q{}", "0123"), 1.0, ""),
        (("stateEstimateZ.quat",), lambda v: unpack_attitude(v[:, 0]), ""),
        (_named("stateEstimate.{}", ANGLES), lambda v: from_euler(v * DEGREES * NOSE), ""),
        (("stateEstimate.roll", "stateEstimate.yaw", *ACCELERATION), _without_pitch, NO_PITCH),
    ],
    "velocity": [(_named("stateEstimate.v{}", "xyz"), 1.0, ""), (_named("stateEstimateZ.v{}", "xyz"), 1e-3, "")],
    "rates": [
        (_named("gyro.{}", "xyz"), DEGREES, ""),
        (_named("controller.r_{}", ANGLES), NOSE, ""),
        (_named("stateEstimateZ.rate{}", map(str.title, ANGLES)), 1e-3 * NOSE, ""),
    ],
    "specific_force": [
        (_named("acc.{}", "xyz"), GRAVITY, ""),
        (("controller.accelz",), GRAVITY, ""),
        (ACCELERATION, lambda v: GRAVITY * np.linalg.norm(v + UP, axis=1, keepdims=True), NO_FORCE),
    ],
    "voltage": [(("pm.vbatMV",), 1e-3, ""), (("pm.vbat",), 1.0, "")],
    "rotor_speed": [(_named("rpm.m{}", MOTORS), np.pi / 30, "")],
    "command": [
        (_named("pwm.m{}_pwm", MOTORS), 1 / FULL, ""),
        (_named("motor.m{}", MOTORS), 1 / FULL, ""),
        (_named("controller.cmd_{}", ("thrust", *ANGLES)), lambda v: np.clip(v @ MIXER.T, 0, LIMITED) / FULL, NO_MOTOR),
    ],
}
Variables = dict[str, tuple[np.ndarray, np.ndarray]]  # variable → its ticks [µs] and values


def read_crazyflie(content: bytes) -> Parts:
    """Read one log. Commands are the PWM or, without it, the mixer's output, as shares of 65536."""
    try:
        events, at = _header(content)
    except (struct.error, IndexError, UnicodeDecodeError) as error:
        raise ValueError("the header of the µSD log is cut off or damaged; copy the file again") from error
    whole = len(content) > at + 4 and zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little")
    columns, end = _columns(content, at, len(content) - 4 * whole, events)
    if not columns:
        raise ValueError("contains no records; record the flight again, or copy the file again")
    facts, notes = {"format": "Crazyflie µSD", "vehicle": "multirotor of 4 rotors"}, []
    if not whole:
        last = max(ticks[-1] for ticks, _ in columns.values()) - min(ticks[0] for ticks, _ in columns.values())
        facts["damage"] = f"its CRC-32 is wrong: cut off or changed; records end at {1e-6 * float(last):.4g} s"
    elif end != len(content) - 4:
        raise ValueError(f"byte {end}: the event of this record is unknown; was the file written by other firmware?")
    for name, (ticks, values) in columns.items():
        jumps = np.flatnonzero(np.abs(np.diff(values.astype(float))) > 0.98 * LIMITED) + 1
        for row in jumps[:1] if values.dtype == np.int16 else ():
            at, numbers = 1e-6 * float(ticks[row] - ticks[0]), f"{values[row - 1]:g} to {values[row]:g}"
            raise ValueError(f"{name}: goes from {numbers} at {at:.4g} s: 16 bits wrapped; log it as a float")
    parts = dict(_parts(columns, notes))
    used = {name for part in parts.values() for name in part.source.split()}
    if rest := sorted({name.split(".")[0] for name in columns.keys() - used}):
        notes.append(f"groups with variables that are not used: {', '.join(rest)}")
    return parts, 1e-6, notes, facts


def is_crazyflie(head: bytes) -> bool:
    """Whether a file is a log of the µSD deck, by its unpacked first bytes."""
    return len(head) >= 3 and head[0] == MAGIC and head[1:3] == VERSION.to_bytes(2, "little")


def _header(content: bytes) -> tuple[dict[bytes, tuple[list[str], np.dtype]], int]:
    """Return the variables and type of each event by its id, and where the records begin."""
    if not is_crazyflie(content):
        raise ValueError(f"is not a µSD log of version {VERSION} of a Crazyflie; copy the file again")
    count, at, events = *struct.unpack_from("<H", content, 3), 5, {}
    for _ in range(count):
        key = content[at : at + 2]
        at = _text(content, at + 2)[1]
        (variables,) = struct.unpack_from("<H", content, at)
        at, names, kinds = at + 2, [], [("ticks", "<u8")]
        for i in range(variables):
            text, at = _text(content, at)
            match = _VARIABLE.fullmatch(text)
            if match is None:
                raise ValueError(f"byte {at}: {text[:40]!r} is not a variable with its type; copy the file again")
            names.append(match[1])
            kinds.append((str(i), f"<{match[2].translate(KINDS)}"))
        events[key] = names, np.dtype(kinds)
    return events, at


def _text(content: bytes, at: int) -> tuple[str, int]:
    end = content.index(b"\0", at) if b"\0" in content[at : at + 256] else len(content)
    return content[at:end].decode("ascii"), end + 1 if end < len(content) else len(content)


def _columns(content: bytes, at: int, end: int, events) -> tuple[Variables, int]:
    """Return the variables of all complete records, and where the records end."""
    starts, sizes = {key: array.array("q") for key in events}, {key: kind.itemsize for key, (_, kind) in events.items()}
    while at + 2 <= end and (size := sizes.get(key := content[at : at + 2])) and at + 2 + size <= end:
        starts[key].append(at + 2)
        at += 2 + size
    data, found = np.frombuffer(content, np.uint8), {}
    for key, (names, kind) in events.items():
        if starts[key]:
            rows = np.empty((len(starts[key]), sizes[key]), np.uint8)
            for column in range(sizes[key]):  # an index of every byte would take eight times the memory of the log
                rows[:, column] = data[np.asarray(starts[key]) + column]
            table = rows.view(kind)[:, 0]
            ticks = table["ticks"].astype(np.int64)
            found |= {name: (ticks, table[str(i)]) for i, name in enumerate(names)}
    return found, at


def _parts(columns: Variables, notes: list[str]) -> Iterator[tuple[str, Samples]]:
    for quantity, places in SOURCES.items():
        for names, change, note in places:
            ticks = {len(columns[name][0]) for name in names if name in columns}
            if {*names} <= columns.keys() and len(ticks) == 1:  # of one event type
                values = np.stack([columns[name][1] for name in names], axis=1).astype(float)
                values = change(values) if callable(change) else values * change
                notes += [note] * bool(note)
                yield quantity, Samples(columns[names[0]][0], values, " ".join(names))
                break
