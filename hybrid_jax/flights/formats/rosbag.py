"""Read bags of ROS 2 (SQLite or MCAP) and ROS 1 with rosbags (extra `logs`).

Odometry, poses, IMU and battery are found by their message types. Motors have no message type of their own, and two
topics may hold one quantity: then the topics are named, as in {"odometry": "/mavros/odometry"} and
{"motors": "/rotors:data:rpm"}, of the topic, the field that holds one number for each motor, and its unit.

Frames are those of REP 103 and 105: world z up, body forward-left-up, an odometry's twist in the body.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_jax.flights.formats import raw
from hybrid_jax.flights.formats.column_map import REST, SCALES, SHARES
from hybrid_jax.flights.formats.raw import BATTERY, WXYZ, XYZ, Samples
from hybrid_jax.flights.recording import Recording

# Role → message types, without package; the roles are the keys of `topics`, with "motors".
TYPES = {"odometry": ("Odometry",), "pose": ("PoseStamped",), "imu": ("Imu",), "voltage": ("BatteryState",)}
ROLES = (*TYPES, "motors")
FIELDS = ("angular_velocities", "velocity")  # of motors, in rad/s by the definition of their messages
_Reader = Callable[[Any], list[float]]


def _xyz(vector) -> list[float]:
    return [vector.x, vector.y, vector.z]


def _wxyz(q) -> list[float]:
    return [q.w, q.x, q.y, q.z]


# Role → quantity → its axes and how it is read from a message.
READERS: dict[str, dict[str, tuple[tuple[str, ...], _Reader]]] = {
    "pose": {
        "position": (XYZ, lambda message: _xyz(message.pose.position)),
        "attitude": (WXYZ, lambda message: _wxyz(message.pose.orientation)),
    },
    "odometry": {
        "position": (XYZ, lambda message: _xyz(message.pose.pose.position)),
        "attitude": (WXYZ, lambda message: _wxyz(message.pose.pose.orientation)),
        "body_velocity": (XYZ, lambda message: _xyz(message.twist.twist.linear)),
        "rates": (XYZ, lambda message: _xyz(message.twist.twist.angular)),
    },
    "imu": {
        "rates": (XYZ, lambda message: _xyz(message.angular_velocity)),
        "specific_force": (XYZ, lambda message: _xyz(message.linear_acceleration)),
    },
    "voltage": {"voltage": (BATTERY, lambda message: [message.voltage])},
}


def read_rosbag(path: str | Path, topics: Mapping[str, str] | None = None) -> Recording:
    """Read one bag: a folder with metadata.yaml, or a file .mcap, .db3 or .bag.

    Raises:
        ValueError: file, topic, time and what to do, in one line; or rosbags is not installed.
    """
    topics = topics or {}
    if unknown := topics.keys() - set(ROLES):
        raise ValueError(f"topics: must name {', '.join(ROLES)}, got {', '.join(sorted(unknown))}")
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ValueError(f"{path}: reading bags needs rosbags: pip install 'hybrid_jax[logs]'") from error
    try:
        with AnyReader([Path(path)], default_typestore=get_typestore(Stores.LATEST)) as bag:
            types = {each.topic: each.msgtype for each in bag.connections if each.msgcount}
            chosen = _chosen(path, types, topics)
            wanted = [each for each in bag.connections if each.topic in {topic for topic, *_ in chosen.values()}]
            messages: dict[str, list[tuple[int, Any]]] = {each.topic: [] for each in wanted}
            for each, at, content in bag.messages(wanted) if wanted else ():
                messages[each.topic].append((at, bag.deserialize(content, each.msgtype)))
    except ValueError:
        raise
    except Exception as error:  # a damaged bag makes its libraries raise any exception
        why = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
        raise ValueError(
            f"{path}: is no bag, or is cut off or damaged: ros2 bag reindex, or copy it again ({why})"
        ) from error
    if empty := [topic for topic, found in messages.items() if not found]:
        raise ValueError(f"{path}: topic {empty[0]} has lost its messages; ros2 bag reindex, or copy it again")
    parts: dict[str, Samples] = {}
    for role, (topic, field, unit) in chosen.items():
        found = _motors(path, topic, field, unit, messages[topic]) if field else _states(role, topic, messages[topic])
        parts |= dict(found)
    used = {topic for topic, *_ in chosen.values()}
    notes = [f"topics that are not used: {', '.join(sorted(types.keys() - used))}"] if types.keys() - used else []
    return raw.record(path, parts, 1e-9, notes, {"format": "ROS bag"})


def _chosen(path, types: Mapping[str, str], topics: Mapping[str, str]) -> dict[str, tuple[str, str, str]]:
    """Role → topic, and of motors field and unit; of a pose and an odometry, the odometry is read last and counts."""
    found = {}
    for role in ("pose", "odometry", "imu", "voltage"):
        fitting = [topic for topic, kind in types.items() if kind.split("/")[-1] in TYPES[role]]
        if role in topics:
            _require(path, topics[role], types)
            fitting = [topics[role]]
        if len(fitting) > 1:
            first, *_ = names = sorted(fitting)
            choose = f'choose one: topics={{"{role}": "{first}"}}'
            raise ValueError(f"{path}: topics {' and '.join(names)} hold {role}; {choose}")
        if fitting:
            found[role] = (fitting[0], "", "")
    if "motors" in topics:
        topic, *given = topics["motors"].split(":")
        _require(path, topic, types)
        if len(given) != 2 or given[1] not in SCALES["motors"] or given[1] == "command":
            units = ", ".join(unit for unit in SCALES["motors"] if unit != "command")
            raise ValueError(
                f"topics: motors must be TOPIC:FIELD:UNIT, the unit one of {units}; got {topics['motors']}"
            )
        found["motors"] = (topic, *given)
    elif fitting := [topic for topic, kind in types.items() if kind.split("/")[-1] == "Actuators"]:
        found["motors"] = (sorted(fitting)[0], "|".join(FIELDS), "rad/s")
    return found


def _require(path, topic: str, types: Mapping[str, str]) -> None:
    if topic not in types:
        raise ValueError(f"{path}: has no messages of topic {topic}, only of {', '.join(sorted(types)) or 'none'}")


def _stamps(messages) -> np.ndarray:
    """Ticks [ns] of the headers, where there are any, else of the bag."""
    headers = [getattr(message, "header", None) for _, message in messages]
    if all(header is not None and (header.stamp.sec or header.stamp.nanosec) for header in headers):
        return np.array([header.stamp.sec * 10**9 + header.stamp.nanosec for header in headers if header], np.int64)
    return np.array([at for at, _ in messages], np.int64)


def _states(role: str, topic: str, messages) -> Iterator[tuple[str, Samples]]:
    ticks = _stamps(messages)
    for quantity, (axes, read) in READERS[role].items():
        yield quantity, Samples(ticks, np.array([read(message) for _, message in messages], float), axes, topic)


def _motors(path, topic: str, field: str, unit: str, messages) -> Iterator[tuple[str, Samples]]:
    fields = field.split("|")
    name = next((name for name in fields if len(getattr(messages[0][1], name, ()))), fields[0])
    rows = [np.asarray(getattr(message, name, ()), float).ravel() for _, message in messages]
    counts = {len(row) for row in rows}
    if len(counts) > 1 or not 3 <= min(counts) <= 12:
        found = ", ".join(map(str, sorted(counts)))
        raise ValueError(f"{path}: {topic}: field {name} holds {found} numbers, must be one for each of 3 to 12 motors")
    values = (np.stack(rows) - REST.get(unit, 0.0)) * SCALES["motors"][unit]
    quantity = "command" if unit in SHARES else "rotor_speed"
    yield quantity, Samples(_stamps(messages), values, tuple(map(str, range(values.shape[1]))), f"{topic} {name}")
