"""Read PX4 ULog files of PX4 1.5 to 1.16, plain or gzip, with pyulog (extra `logs`).

Attitudes are body FRD → world NED (msg/versioned/VehicleAttitude.msg, VehicleLocalPosition.msg); for the format see
docs.px4.io, "ULog File Format".
"""

import contextlib
import io
import struct
import tempfile
from typing import Any

import numpy as np

from hybrid_jax.flights.formats.raw import Parts, Samples, turned
from hybrid_jax.vehicle import FEWEST_ROTORS

ODOMETRY, LOCAL, ATTITUDE = "vehicle_odometry", "vehicle_local_position", "vehicle_attitude"
STATUS, OUTPUTS = "vehicle_status", "actuator_outputs"
# Quantity → its possible topics and fields, of which the first in a log is used. For ULog, and px4_msgs in bags.
SOURCES: dict[str, tuple[tuple[str, tuple[str, ...]], ...]] = {
    "position": ((LOCAL, ("x", "y", "z")), (ODOMETRY, tuple(f"position[{i}]" for i in range(3)))),
    "velocity": ((LOCAL, ("vx", "vy", "vz")), (ODOMETRY, tuple(f"velocity[{i}]" for i in range(3)))),
    "attitude": tuple((topic, tuple(f"q[{i}]" for i in range(4))) for topic in (ATTITUDE, ODOMETRY)),
    "rates": (
        ("vehicle_angular_velocity", tuple(f"xyz[{i}]" for i in range(3))),  # from 1.10 on
        ("sensor_combined", tuple(f"gyro_rad[{i}]" for i in range(3))),
        (ATTITUDE, ("rollspeed", "pitchspeed", "yawspeed")),  # until 1.9
        (ODOMETRY, tuple(f"angular_velocity[{i}]" for i in range(3))),
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
IDLE_PWM, FULL_PWM = 1000.0, 2000.0  # µs, by default
LEAST_PWM = 700.0  # µs; PWM is never less
UAVCAN, DSHOT = 8191.0, 1999.0  # outputs at full command
SLOWEST_RPM = 1500.0  # rpm: any simulated multirotor is faster at some time
MOST = 16  # motors or outputs in any topic


def read_ulog(content: bytes) -> Parts:
    """Read one log. Commands are in 0 … 1; PWM is scaled by the log's minimum and maximum."""
    log, damage = _load(content)
    tables, notes = _instances(log.data_list)
    kinds = {0: "generic"} | OTHERS | {kind: f"multirotor of {count} rotors" for kind, count in ROTORS.items()}
    kind = _kind(log.initial_parameters, tables)
    release, hardware = _whole(log.msg_info_dict, "ver_sw_release"), log.msg_info_dict.get("ver_hw", "unknown hardware")
    version = f" {release >> 24}.{release >> 16 & 255}.{release >> 8 & 255}" * bool(release)
    facts = {"format": "PX4 ULog", "vehicle": kinds.get(kind, "unknown"), "program": f"PX4{version} on {hardware}"}
    for name, parameter in (("airframe", "SYS_AUTOSTART"), ("SDLOG_PROFILE", "SDLOG_PROFILE")):
        facts[name] = str(log.initial_parameters.get(parameter, "unknown"))
    facts |= {"damage": damage} if damage else {}
    if log.dropouts:
        longest = max(each.duration for each in log.dropouts)
        notes.append(f"{len(log.dropouts)} dropouts of the logger, the longest of {longest} ms")
    simulated = "SITL" in facts["program"]
    parts = states(tables, notes)
    parts |= motors(tables, log.initial_parameters, ROTORS.get(kind, 0), notes, simulated)
    return parts, 1e-6, notes, facts


def _instances(data) -> tuple[dict[str, Any], list[str]]:
    """Return the first instance of each topic that changes, or else the first, with notes about the others."""
    chosen = {}
    for each in sorted(data, key=lambda each: each.multi_id):
        values = [column for name, column in each.data.items() if not name.startswith(("timestamp", "noutputs"))]
        changing = sum(len(column) > 1 and bool((column != column[0]).any()) for column in values)
        alive = changing >= (FEWEST_ROTORS if each.name == OUTPUTS else 1)
        if each.name not in chosen or (alive and not chosen[each.name][1]):
            chosen[each.name] = each, alive
    notes = []
    for each in data:
        kept, alive = chosen[each.name]
        why = f": instance {kept.multi_id} changes" if kept.multi_id and alive else ""
        notes += [f"{each.name}: instance {each.multi_id} is left out{why}"] * (each is not kept)
    return {name: kept.data for name, (kept, _) in chosen.items()}, notes


def _load(content: bytes) -> tuple[Any, str]:
    """Return the log and a description of any damage."""
    try:
        import pyulog
    except ImportError as error:
        raise ValueError("reading ULog needs pyulog: pip install 'hybrid_jax[logs]'") from error
    try:
        # pyulog reports damage on standard output only. From memory, where a seek stops at 0, it may loop forever.
        with contextlib.redirect_stdout(io.StringIO()), tempfile.TemporaryFile() as file:
            file.write(content)
            file.seek(0)
            log = pyulog.ULog(file, TOPICS)
        cut = _cut(content)
    except Exception as error:  # pyulog raises any exception for a damaged file
        raise ValueError(f"is not a ULog or is damaged; download it again ({type(error).__name__})") from error
    seconds = (log.last_timestamp - log.start_timestamp) * 1e-6
    if log.file_corruption:
        raise ValueError(f"is damaged before {seconds:.4g} s (corrupt messages); download it again")
    return log, f"ends in the middle of a message, after {seconds:.4g} s" * cut


def _cut(content: bytes) -> bool:
    """Whether the last message is incomplete, which pyulog does not report."""
    at = 16  # behind the header
    if content[at + 2 : at + 3] == b"B":  # appended data begin at an offset, even if data before it were cut
        at = max(at, *struct.unpack("<3Q", content[at + 19 : at + 43]))
    while at + 3 <= len(content):
        size = int.from_bytes(content[at : at + 2], "little")
        if not size:  # messages are never empty, so zeros follow
            return True
        at += 3 + size
    return at != len(content)


def _kind(parameters, tables) -> int:
    """Return the vehicle's MAV_TYPE; −1 if unknown."""
    kind = _whole(parameters, "MAV_TYPE") or int(tables.get(STATUS, {}).get("system_type", [0])[-1])
    airframe = _whole(parameters, "SYS_AUTOSTART")
    if 13000 <= airframe < 14000 or any(tables.get(STATUS, {}).get("is_vtol", ())):
        return 22
    return kind or -1


def _whole(parameters, name: str) -> int:
    """Return an integer parameter, or 0."""
    given = parameters.get(name, 0)
    return int(given) if isinstance(given, int | float) and np.isfinite(given) else 0


def _has(tables, topic: str, fields) -> bool:
    """Whether a topic has its time and these fields, as far as the log is readable."""
    return {"timestamp", *fields} <= {*tables.get(topic, ())}


def _table(tables, topic: str, fields, clock: str = "timestamp_sample") -> tuple[np.ndarray, np.ndarray]:
    """Return the ticks [µs] and fields of a topic."""
    table = tables[topic]
    # The time of the measurement if it is recorded, else of the message.
    use_clock = clock in table and table[clock].min(initial=1) > 0
    ticks = table[clock if use_clock else "timestamp"].astype(np.int64)
    with np.errstate(invalid="ignore"):  # damaged numbers are rejected later
        return ticks, np.stack([table[field] for field in fields], axis=1).astype(float)


def states(tables, notes: list[str]) -> dict[str, Samples]:
    """Read the quantities of `SOURCES` from tables of topics: field → array."""
    found = {}
    for quantity, places in SOURCES.items():
        topic, fields = next((place for place in places if _has(tables, *place)), ("", ()))
        if topic:
            ticks, values = _table(tables, topic, fields)
            if quantity in VALID:
                ticks, values = _valid(tables[topic], quantity, ticks, values, notes)
            found[quantity] = Samples(ticks, values, f"{topic} {' '.join(fields)}")
    return turned(found, "NED", "FRD")


def _valid(table, quantity: str, ticks, values, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples that the estimator marks as valid."""
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


def motors(tables, parameters, expected: int, notes: list[str], simulated: bool = False) -> dict[str, Samples]:
    """Read rotor speeds and commands of all motors. The log's own number of rotors replaces `expected`."""
    expected, found = _whole(parameters, "CA_ROTOR_COUNT") or expected, {}
    for topic, field in MOTORS.items():
        quantity = "rotor_speed" if topic == "esc_status" else "command"
        fields = [name for name in map(field.format, range(MOST)) if _has(tables, topic, (name,))]
        if not fields or quantity in found:
            continue
        ticks, values = _table(tables, topic, fields, "timestamp")
        moving = [i for i in range(len(fields)) if len(np.unique(values[np.isfinite(values[:, i]), i])) > 1]
        count = max(expected, max(moving, default=-1) + 1)  # keep all motors: checks compare them with the vehicle
        if topic == "esc_status" and not moving:
            continue  # ESCs without telemetry report zero
        if not 0 < count <= len(fields):
            notes.append(f"{topic}: {count} of {len(fields)} motors move: left out")
            continue
        # PX4 writes NaN for a motor that is disarmed.
        used = np.nan_to_num(values[:, :count], nan=0.0)
        if topic == "esc_status":
            used = np.abs(used)
            in_radians = bool(simulated and used.max() < SLOWEST_RPM)
            used = used if in_radians else used * np.pi / 30
            notes += [f"{topic}: esc_rpm is in rad/s, as PX4_SITL writes it for Gazebo: read as such"] * in_radians
        elif topic == OUTPUTS:
            used, unit = _shares(used, parameters)
            notes.append(f"{OUTPUTS}: commands are shares {unit}")
        found[quantity] = Samples(ticks, used, topic)
    return found


def _shares(outputs: np.ndarray, parameters) -> tuple[np.ndarray, str]:
    """Scale outputs to 0 … 1, and describe their unit, which follows from their range."""
    running = outputs[outputs > 0]
    low, full = (_pwm(parameters, end, default) for end, default in (("MIN", IDLE_PWM), ("MAX", FULL_PWM)))
    unit = f"from {low:g} to {full:g} µs"
    if len(running) and running.max() <= 1:
        low, full, unit = 0.0, 1.0, "from 0 to 1"
    elif len(running) and running.max() > 1.2 * FULL_PWM:
        low, full, unit = 0.0, UAVCAN, f"of UAVCAN's {UAVCAN:g}"
    elif len(running) and np.quantile(running, 0.01) < LEAST_PWM:
        low, full, unit = 0.0, DSHOT, f"of DShot's {DSHOT:g}"
    return np.maximum(outputs - low, 0.0) / (full - low), unit


def _pwm(parameters, end: str, default: float) -> float:
    """Return the parameter PWM_MIN or PWM_MAX, in later versions PWM_MAIN_MIN1 …"""
    given = (_whole(parameters, name) for name in (f"PWM_MAIN_{end}1", f"PWM_MAIN_{end}", f"PWM_{end}"))
    return float(next((value for value in given if value > 0), default))
