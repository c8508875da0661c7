"""Read PX4 ULog files, plain or gzip, of PX4 1.5 to 1.16, with pyulog (extra `logs`).

PX4 states attitude as body FRD → world NED and vectors in these frames (msg/versioned/VehicleAttitude.msg,
msg/versioned/VehicleLocalPosition.msg); the format is that of docs.px4.io, "ULog File Format".
"""

import contextlib
import io
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_jax.flights.formats import raw
from hybrid_jax.flights.formats.raw import BATTERY, WXYZ, XYZ, Samples
from hybrid_jax.flights.recording import Recording

LOCAL, ATTITUDE, STATUS, OUTPUTS = "vehicle_local_position", "vehicle_attitude", "vehicle_status", "actuator_outputs"
# Quantity → where it may stand, the first that a log has counts: topic and fields.
SOURCES: dict[str, tuple[tuple[str, tuple[str, ...]], ...]] = {
    "position": ((LOCAL, ("x", "y", "z")),),
    "velocity": ((LOCAL, ("vx", "vy", "vz")),),
    "attitude": ((ATTITUDE, tuple(f"q[{i}]" for i in range(4))),),
    "rates": (
        ("vehicle_angular_velocity", tuple(f"xyz[{i}]" for i in range(3))),  # from 1.10 on
        ("sensor_combined", tuple(f"gyro_rad[{i}]" for i in range(3))),
        (ATTITUDE, ("rollspeed", "pitchspeed", "yawspeed")),  # until 1.9
    ),
    "specific_force": (
        ("sensor_combined", tuple(f"accelerometer_m_s2[{i}]" for i in range(3))),
        ("vehicle_acceleration", tuple(f"xyz[{i}]" for i in range(3))),
    ),
    "voltage": (("battery_status", ("voltage_v",)),),
}
VALID = {"position": ("xy_valid", "z_valid"), "velocity": ("v_xy_valid", "v_z_valid")}
RESETS = {"position": ("xy_reset_counter", "z_reset_counter"), "velocity": ("vxy_reset_counter", "vz_reset_counter")}
MOTORS = {"esc_status": "esc[{}].esc_rpm", "actuator_motors": "control[{}]", OUTPUTS: "output[{}]"}  # topic → field
TOPICS = sorted({topic for each in SOURCES.values() for topic, _ in each} | {*MOTORS, STATUS})
ROTORS = {2: 4, 13: 6, 14: 8, 15: 3, 29: 12, 35: 10}  # MAV_TYPE of multirotors → rotors
OTHERS = {1: "fixed wing", 3: "coaxial helicopter", 4: "helicopter", 7: "airship", 10: "rover", 11: "boat"}
OTHERS |= {12: "submarine"} | dict.fromkeys(range(19, 26), "VTOL")
IDLE_PWM, FULL_PWM = 1000.0, 2000.0  # µs, where a log does not say
MOST = 16  # motors or outputs in any topic


def read_ulog(path: str | Path) -> Recording:
    """Read one log. Commands are shares of the largest, of PWM between the log's minimum and maximum.

    Raises:
        ValueError: file, topic, time and what to do, in one line; or pyulog is not installed.
    """
    log, damage = _load(path)
    tables = {each.name: each.data for each in reversed(log.data_list)}  # the first instance of each topic
    notes = [f"{each.name}: instance {each.multi_id} is left out" for each in log.data_list if each.multi_id]
    kinds = {0: "generic"} | OTHERS | {kind: f"multirotor of {count} rotors" for kind, count in ROTORS.items()}
    kind = _kind(log.initial_parameters, tables)
    facts = {"format": "PX4 ULog", "vehicle": kinds.get(kind, "unknown"), "program": _release(log.msg_info_dict)}
    facts |= {"airframe": str(log.initial_parameters.get("SYS_AUTOSTART", "unknown"))}
    facts |= {"SDLOG_PROFILE": str(log.initial_parameters.get("SDLOG_PROFILE", "unknown"))}
    facts |= {"damage": damage} if damage else {}
    if log.dropouts:
        longest = max(each.duration for each in log.dropouts)
        notes.append(f"{len(log.dropouts)} dropouts of the logger, the longest of {longest} ms")
    parts = dict(_states(path, tables, notes))
    parts |= _motors(path, tables, log.initial_parameters, ROTORS.get(kind, 0), notes)
    return raw.record(path, parts, 1e-6, notes, facts)


def _load(path: str | Path) -> tuple[Any, str]:
    """The log, and how it is damaged; empty if it is not."""
    try:
        import pyulog
    except ImportError as error:
        raise ValueError(f"{path}: reading ULog needs pyulog: pip install 'hybrid_jax[logs]'") from error
    content = raw.unpacked(path)
    try:
        # pyulog reports damage on standard output only. In memory, where a seek stops at 0, it may go round for ever.
        with contextlib.redirect_stdout(io.StringIO()), tempfile.TemporaryFile() as file:
            file.write(content)
            file.seek(0)
            log = pyulog.ULog(file, TOPICS)
        cut = _cut(content)
    except Exception as error:  # pyulog raises any exception for a damaged file
        raise ValueError(f"{path}: is not a ULog or is damaged; download it again ({type(error).__name__})") from error
    seconds = (log.last_timestamp - log.start_timestamp) * 1e-6
    if log.file_corruption:
        raise ValueError(f"{path}: is damaged before {seconds:.4g} s (corrupt messages); download it again")
    return log, f"ends in the middle of a message, after {seconds:.4g} s" * cut


def _cut(content: bytes) -> bool:
    """Whether the last message is incomplete, which pyulog does not say."""
    at = 16
    if content[at + 2 : at + 3] == b"B":  # appended data begin anew at an offset, whatever was cut before it
        at = max(at, *struct.unpack("<3Q", content[at + 19 : at + 43]))
    while at + 3 <= len(content):
        at += 3 + int.from_bytes(content[at : at + 2], "little")
    return at != len(content)


def _kind(parameters, tables) -> int:
    """The vehicle as of MAV_TYPE; −1 where the log does not say."""
    kind = int(parameters.get("MAV_TYPE", 0)) or int(tables.get(STATUS, {}).get("system_type", [0])[-1])
    airframe = int(parameters.get("SYS_AUTOSTART", 0))
    if 13000 <= airframe < 14000 or any(tables.get(STATUS, {}).get("is_vtol", ())):
        return 22
    return kind or -1


def _release(info) -> str:
    number = int(info.get("ver_sw_release", 0))
    version = f"PX4 {number >> 24}.{number >> 16 & 255}.{number >> 8 & 255}" if number else "PX4"
    return f"{version} on {info.get('ver_hw', 'unknown hardware')}"


def _table(path, tables, topic: str, fields, clock: str = "timestamp_sample") -> tuple[np.ndarray, np.ndarray]:
    """Ticks [µs] and fields of a topic."""
    table = tables[topic]
    # The time of the measurement where it is recorded, else that of the message.
    use_clock = clock in table and table[clock].min(initial=1) > 0
    ticks = table[clock if use_clock else "timestamp"].astype(np.int64)
    if len(ticks) > 1 and (np.abs(ticks[-1] - ticks[0]) > 1e12):
        raise ValueError(f"{path}: {topic}: time stamps span {1e-6 * abs(ticks[-1] - ticks[0]):.3g} s: is damaged")
    with np.errstate(invalid="ignore"):  # damaged numbers are refused later
        return ticks, np.stack([table[field] for field in fields], axis=1).astype(float)


def _states(path, tables, notes: list[str]) -> Iterator[tuple[str, Samples]]:
    for quantity, places in SOURCES.items():
        found = [(topic, fields) for topic, fields in places if topic in tables and {*fields} <= {*tables[topic]}]
        if not found:
            continue
        topic, fields = found[0]
        ticks, values = _table(path, tables, topic, fields)
        if quantity in VALID:
            ticks, values = _valid(tables[topic], quantity, ticks, values, notes)
        if quantity == "attitude":
            values = raw.attitude(values, "NED", "FRD")
        elif quantity != "voltage":
            values = raw.world(values, "NED") if topic == LOCAL else raw.body(values, "FRD")
        axes = {"attitude": WXYZ, "voltage": BATTERY}.get(quantity, XYZ)
        yield quantity, Samples(ticks, values, axes, f"{topic} {' '.join(fields)}")


def _valid(table, quantity: str, ticks, values, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """The samples that the estimator calls valid."""
    known = np.ones(len(ticks), bool)
    for flag in VALID[quantity]:
        known &= table.get(flag, np.ones(len(ticks))) > 0
    if not known.all():
        notes.append(f"{LOCAL}: {quantity} is not valid in {(~known).sum()} of {len(known)} samples: left out")
    for counter in RESETS[quantity]:
        resets = np.flatnonzero(np.diff(table.get(counter, np.zeros(1)).astype(int))) + 1
        times = ", ".join(f"{1e-6 * float(ticks[i] - ticks[0]):.4g}" for i in resets[:5])
        notes += [f"{LOCAL}: the estimator reset the {quantity} ({counter}) at {times} s"] * bool(len(resets))
    return ticks[known], values[known]


def _motors(path, tables, parameters, expected: int, notes: list[str]) -> dict[str, Samples]:
    """Rotor speeds and commands of all motors that the log knows."""
    expected, found = int(parameters.get("CA_ROTOR_COUNT", 0)) or expected, {}
    for topic, field in MOTORS.items():
        quantity = "rotor_speed" if topic == "esc_status" else "command"
        fields = [field.format(i) for i in range(MOST) if topic in tables and field.format(i) in tables[topic]]
        if not fields or quantity in found:
            continue
        ticks, values = _table(path, tables, topic, fields, "timestamp")
        moving = [i for i in range(len(fields)) if len(np.unique(values[np.isfinite(values[:, i]), i])) > 1]
        count = max(expected, max(moving, default=-1) + 1)  # no motor is dropped: checks compare with the vehicle
        if topic == "esc_status" and not moving:
            continue  # ESCs without telemetry report zero
        if not 0 < count <= len(fields):
            notes.append(f"{topic}: {count} of {len(fields)} motors move: left out")
            continue
        used = values[:, :count]
        if topic == "esc_status":
            used = np.abs(used) * np.pi / 30
        elif topic == OUTPUTS:
            low, full = (_pwm(parameters, end, default) for end, default in (("MIN", IDLE_PWM), ("MAX", FULL_PWM)))
            used = np.maximum(used - low, 0.0) / (full - low)
            notes.append(f"{OUTPUTS}: commands are shares from {low:g} to {full:g} µs")
        # PX4 writes NaN for a motor that is disarmed.
        found[quantity] = Samples(ticks, np.nan_to_num(used, nan=0.0), tuple(map(str, range(count))), topic)
    return found


def _pwm(parameters, end: str, default: float) -> float:
    """PWM_MIN or PWM_MAX, in later versions PWM_MAIN_MIN1 …"""
    given = (parameters.get(name, 0) for name in (f"PWM_MAIN_{end}1", f"PWM_MAIN_{end}", f"PWM_{end}"))
    return float(next((value for value in given if value > 0), default))
