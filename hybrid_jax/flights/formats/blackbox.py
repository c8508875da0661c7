"""Read Betaflight blackbox logs with orangebox (extra `logs`; GPL-3).

Units are documented in betaflight/src/main/blackbox/blackbox.c: gyroADC in deg/s times `gyro_scale`, accSmooth in g /
`acc_1G`, eRPM in 100 / min of `motor_poles` poles. Betaflight's body is forward-left-up.
"""

import contextlib
import io
import logging
import os
import re
import struct
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np

from hybrid_jax.flights.formats.raw import Parts, Samples

GRAVITY, MOST, POLES, DSHOT = 9.81, 12, 14, 2047
MAGIC = b"H Product:Blackbox"
ADJUSTED, RESUMED, DISARMED, ENDED = 13, 14, 15, 255  # events
FULL = {True: (48.0, 2047.0), False: (1000.0, 2000.0)}  # motors at rest and at most: of DShot and of PWM


def read_blackbox(content: bytes) -> Parts:
    """Read the longest flight of a file. Commands are in 0 … 1; rotor speeds need bidirectional DShot."""
    try:
        import orangebox  # noqa: F401
    except ImportError as error:
        raise ValueError("reading blackbox needs orangebox: pip install 'hybrid_jax[logs]'") from error
    logging.getLogger("orangebox").setLevel(logging.ERROR)
    flights, why = [], []
    begins = [found.start() for found in re.finditer(re.escape(MAGIC), content)]
    for begin, end in zip(begins, [*begins[1:], len(content)], strict=True):
        try:  # each separately, because orangebox would read the whole file for each
            flights.append(_frames(content[begin:end]))
        except Exception as error:  # orangebox raises any exception for a damaged header, or for no frames
            why.append(type(error).__name__)
    parser, rows, damage = max(flights, key=lambda flight: len(flight[1]), default=(None, np.zeros((0, 0)), ""))
    if parser is None:
        reason = f" ({why[0]})" if why else ""
        raise ValueError(f"is not a blackbox log or is damaged; save it again{reason}")
    if not len(rows):
        raise ValueError("contains no frames; save the log again")
    columns = dict(zip(parser.field_names, rows.T, strict=False))
    if "time" not in columns:
        raise ValueError("has no field time; save the log again")
    headers = parser.headers
    program = str(headers.get("Firmware revision", headers.get("Firmware type", "unknown")))
    facts = {"format": "Betaflight blackbox", "program": program, "vehicle": "multirotor"}
    facts |= {"damage": damage} if damage else {}
    notes = [] if "betaflight" in program.lower() else ["not of Betaflight: its units are assumed"]
    flown = sum(len(each[1]) > 1 for each in flights)
    notes += [f"contains {flown} flights: the longest is read; save each by itself"] * (flown > 1)
    empty = len(begins) - flown
    notes += [f"{empty} times the vehicle was armed and nothing was recorded: left out"] * (empty > 0)
    return dict(_parts(columns, headers)), 1e-6, notes, facts


@cache
def _parser() -> Any:
    """Extend orangebox's parser by the events of later firmware, which it would count as damage."""
    import orangebox
    from orangebox.decoders import _signed_vb, _unsigned_vb

    class Parser(orangebox.Parser):
        def _parse_event_frame(self, reader: Any):
            kind = reader.value()
            if kind not in (ADJUSTED, RESUMED, DISARMED, ENDED):
                return super()._parse_event_frame(reader)
            next(reader)
            if kind == ENDED:  # some programs add the reason
                self._end_of_log = reader.has_subsequent(b"End of log")
                return self._end_of_log
            if kind == ADJUSTED and next(reader) >= 128:
                reader.seek(reader.tell() + 4)
            elif kind == ADJUSTED:
                _signed_vb(reader)
            else:
                _unsigned_vb(reader)
            if kind == RESUMED:
                _unsigned_vb(reader)
            return True

    return Parser


def _frames(content: bytes) -> tuple[Any, np.ndarray, str]:
    """Return the parser, the main frames as rows, and a description of any damage."""
    from orangebox.reader import Reader
    from orangebox.types import FrameType

    # orangebox only reads files, and a temporary one would stay if the process were killed.
    reader, stream = Reader(os.devnull), io.BytesIO(content)
    reader._update_headers(stream)
    reader._frame_data = stream.read()
    reader._log_index, reader._frame_data_len = 1, len(reader._frame_data)
    reader._build_field_defs()
    parser = _parser()(reader)
    width, rows, ended, junk = len(parser.reader.field_defs[FrameType.INTRA]), [], True, 0
    try:
        for frame in parser.frames():
            junk = junk if rows else parser._ctx.invalid_frame_count
            if rows or frame.type == FrameType.INTRA:  # earlier frames depend on one that is missing
                rows.append(frame.data[:width])
    except Exception:  # the file ends within a frame, which orangebox does not check
        ended = False
    sound = [row for row in rows if all(isinstance(value, int | float) for value in row)]
    invalid = parser._ctx.invalid_frame_count - junk + len(rows) - len(sound)
    damage = "ends within a frame: cut off" if not ended else f"{invalid} frames are damaged" if invalid else ""
    return parser, np.array(sound, float).reshape(len(sound), width), damage


def _parts(columns, headers) -> Iterator[tuple[str, Samples]]:
    def part(names: list[str], factor: float, rest: float = 0.0) -> Samples:
        values = (np.stack([columns[name] for name in names], axis=1) - rest) * factor
        return Samples(columns["time"], values, " ".join(names))

    def of(field: str, most: int) -> list[str]:
        return [name for name in (f"{field}[{i}]" for i in range(most)) if name in columns]

    if len(gyro := of("gyroADC", 3)) == 3:
        fine = 0.1 if headers.get("blackbox_high_resolution") == 1 else 1.0
        yield "rates", part(gyro, _scale(headers) * fine * np.pi / 180)
    if len(acc := of("accSmooth", 3)) == 3:
        yield "specific_force", part(acc, GRAVITY / _number(headers, "acc_1G"))
    if "vbatLatest" in columns:
        # Cells in 0.1 V until Betaflight 3, in 0.01 V from 4 on.
        yield "voltage", part(["vbatLatest"], 0.01 if _most(headers.get("vbatcellvoltage")) > 100 else 0.1)
    if names := of("motor", MOST):
        low, high = FULL[_most(headers.get("motorOutput")) == DSHOT]
        found = part(names, 1 / (high - low), low)
        yield "command", found._replace(values=np.maximum(found.values, 0.0))
    if (names := of("eRPM", MOST)) and columns[names[0]].any():
        yield "rotor_speed", part(names, 100 * 2 / _number(headers, "motor_poles", POLES) * np.pi / 30)


def _scale(headers) -> float:
    """Decode gyro_scale [deg/s per count] from the bits of a float."""
    given = headers.get("gyro_scale", 0x3F800000)
    with contextlib.suppress(struct.error):
        (scale,) = struct.unpack("<f", struct.pack("<I", given))
        if 0 < scale < 100:
            return scale
    raise ValueError(f"header gyro_scale must be the bits of a float, got {str(given)[:40]!r}")


def _most(given) -> float:
    """Return the largest number of a header, or 0."""
    each = given if isinstance(given, list) else [given]
    return max((number for number in each if isinstance(number, int | float)), default=0)


def _number(headers, name: str, usual: float | None = None) -> float:
    given = headers.get(name, usual)
    if not isinstance(given, int | float) or given <= 0:
        raise ValueError(f"header {name} must be a positive number, got {str(given)[:40]!r}")
    return float(given)
