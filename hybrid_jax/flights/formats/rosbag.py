"""Read bags of ROS 2 (SQLite or MCAP) and ROS 1 with rosbags (extra `logs`).

Odometry, poses, IMU and battery are found by message type. You should name the topics of motors, which have no standard
type, and of a quantity with several topics, for example {"odometry": "/mavros/odometry", "motors": "/rotors:data:rpm"}.
For motors, this is the topic, the field with one number per motor, and the unit.

Frames follow REP 103 and 105: world z up, body forward-left-up, and twists of odometry in the body.
"""

import re
from collections.abc import Collection, Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_jax.flights.attitude import rotation_of
from hybrid_jax.flights.formats.column_map import SCALES, SHARES, of_unit
from hybrid_jax.flights.formats.raw import Parts, Samples, Unpacked
from hybrid_jax.flights.formats.ulog import TOPICS, motors, states
from hybrid_jax.flights.log import unlike_one
from hybrid_jax.flights.recording import AXES
from hybrid_jax.vehicle import FEWEST_ROTORS

PX4 = "px4_msgs/"
FIELDS = ("angular_velocities", "velocity")  # of motors, in rad/s by the definition of their messages


def _pose(prefix: str) -> dict[str, str]:
    return {"position": f"{prefix}position", "attitude": f"{prefix}orientation"}


VELOCITY = "twist.twist.linear"
# Role → message type without package → quantity → its field. Roles, and "motors", are keys of `topics`. If two of them
# have the same quantity, the later one is used.
READERS: dict[str, dict[str, dict[str, str]]] = {
    "pose": {
        "PoseStamped": _pose("pose."),
        "PoseWithCovarianceStamped": _pose("pose.pose."),
        "Pose": _pose(""),
        "TransformStamped": {"position": "transform.translation", "attitude": "transform.rotation"},
        "PointStamped": {"position": "point"},
    },
    "odometry": {"Odometry": _pose("pose.pose.") | {"body_velocity": VELOCITY, "rates": "twist.twist.angular"}},
    "velocity": {
        "TwistStamped": {"velocity": "twist.linear"},
        "TwistWithCovarianceStamped": {"velocity": VELOCITY},
        "Vector3Stamped": {"velocity": "vector"},
        "Odometry": {"velocity": VELOCITY},
    },
    "imu": {"Imu": {"rates": "angular_velocity", "specific_force": "linear_acceleration"}},
    "voltage": {"BatteryState": {"voltage": "voltage"}},
}
# Read in a role only if `topics` names them.
ASKED_FOR = {("velocity", "Odometry"), ("velocity", "Vector3Stamped"), ("pose", "PointStamped")}
ROLES = (*READERS, "motors")
Messages = dict[str, list[tuple[int, Any]]]  # topic → time [ns] and content of each


def read_rosbag(path: str | Path, topics: Mapping[str, str]) -> Parts:
    """Read one bag: a folder with metadata.yaml, or a .mcap, .db3 or .bag file."""
    if unknown := topics.keys() - set(ROLES):
        raise ValueError(f"topics: must name {', '.join(ROLES)}, got {', '.join(sorted(unknown))}")
    types, chosen, messages = _heard(path, topics)
    parts, notes, used = {}, [], {*messages}
    for role, (topic, field, unit) in chosen.items():
        heard, ticks = [message for _, message in messages[topic]], _stamps(messages[topic])
        if role == "motors":
            values, name = _motors(topic, field, heard)
            kind = "command" if unit in SHARES else "rotor_speed"
            parts[kind] = Samples(ticks, of_unit(values, unit), f"{topic} {name}")
            continue
        for quantity, place in READERS[role][types[topic].split("/")[-1]].items():
            found = map(attrgetter(place), heard)
            values = [[getattr(each, axis, each) for axis in AXES[quantity][0]] for each in found]  # a voltage has none
            parts[quantity] = Samples(ticks, np.array(values, float), topic)
    if "velocity" in chosen:
        _twist_in_world(parts, chosen["velocity"][0])
    kinds = {topic: kind for topic in messages if (kind := _px4(types[topic]))}
    tables = {kind: _px4_table(messages[topic]) for topic, kind in kinds.items()}
    own = states(tables, notes) | motors(tables, {}, 0, notes)
    parts = {name: part._replace(ticks=1000 * part.ticks) for name, part in own.items()} | parts  # µs, the bag ns
    notes += [f"topics that are not used: {', '.join(sorted(types.keys() - used))}"] if types.keys() - used else []
    return parts, 1e-9, notes, {"format": "ROS bag"}


def _heard(path, topics: Mapping[str, str]) -> tuple[dict[str, str], dict[str, tuple[str, str, str]], Messages]:
    """Return all topics' types, the topic chosen for each role, and the messages of these and of PX4's topics."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ValueError("reading bags needs rosbags: pip install 'hybrid_jax[logs]'") from error
    try:
        with AnyReader([Path(path)], default_typestore=get_typestore(Stores.LATEST)) as bag:
            types = {each.topic: each.msgtype for each in bag.connections if each.msgcount}
            chosen = _chosen(types, topics)
            names = {topic for topic, *_ in chosen.values()}
            names |= {topic for topic in types if _px4(types[topic]) in TOPICS}
            wanted = [each for each in bag.connections if each.topic in names]
            messages: Messages = {each.topic: [] for each in wanted}
            unpacked = Unpacked(Path(path))
            for each, at, content in bag.messages(wanted) if wanted else ():
                unpacked.count(len(content))
                messages[each.topic].append((at, bag.deserialize(content, each.msgtype)))
    except ValueError:
        raise
    except Exception as error:  # a damaged bag makes its libraries raise any exception
        why = f"run ros2 bag reindex, or copy it again ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
        raise ValueError(f"is not a bag, or is cut off or damaged; {why}") from error
    if empty := [topic for topic, found in messages.items() if not found]:
        raise ValueError(f"topic {empty[0]} has lost its messages; run ros2 bag reindex, or copy the bag again")
    return types, chosen, messages


def _twist_in_world(parts: dict[str, Samples], topic: str) -> None:
    """Prefer a topic's velocity in the world to its velocity in the body, and rotate its body rates."""
    parts.pop("body_velocity", None)
    rates, attitude = parts.get("rates"), parts.get("attitude")
    if rates and attitude and rates.source == attitude.source == topic:
        q = np.where(unlike_one(attitude.values)[:, None], [1.0, 0, 0, 0], attitude.values)
        parts["rates"] = rates._replace(values=rotation_of(q).inv().apply(rates.values))


def _px4(kind: str) -> str:
    """Name the PX4 topic of a message of px4_msgs, for example vehicle_attitude for VehicleAttitude; else ""."""
    name = kind.split("/")[-1] if kind.startswith(PX4) else ""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def _px4_table(messages) -> dict[str, np.ndarray]:
    """Map field → array as in a ULog, with one field per array element."""
    rows = [dict(_fields(message)) for _, message in messages]
    return {name: np.array([row[name] for row in rows]) for name in rows[0] if all(name in row for row in rows)}


def _fields(message, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name in (each for each in vars(message) if not each.startswith("_")):
        value = getattr(message, name)
        for i, each in enumerate(value) if isinstance(value, list | np.ndarray) else ():
            if hasattr(each, "__dict__"):
                yield from _fields(each, f"{prefix}{name}[{i}].")
            else:
                yield f"{prefix}{name}[{i}]", each
        if isinstance(value, bool | int | float):
            yield prefix + name, value


def _chosen(types: Mapping[str, str], topics: Mapping[str, str]) -> dict[str, tuple[str, str, str]]:
    """Map role → topic and, for motors, field and unit."""
    found = {}
    for role, kinds in READERS.items():
        known = {kind for kind in kinds if role in topics or (role, kind) not in ASKED_FOR}
        # Of mavros: the same velocity in the body.
        fitting = [topic for topic, kind in types.items() if kind.split("/")[-1] in known and "body" not in topic]
        if role in topics:
            _require(topics[role], types, role, known)
            fitting = [topics[role]]
        if len(fitting) > 1:
            first, *_ = names = sorted(fitting)
            choose = f'choose one: topics={{"{role}": "{first}"}}'
            raise ValueError(f"topics {' and '.join(names)} have {role}; {choose}")
        if fitting:
            found[role] = (fitting[0], "", "")
    if "motors" in topics:
        topic, *given = topics["motors"].split(":")
        _require(topic, types)
        if len(given) != 2 or given[1] not in SCALES["motors"] or given[1] == "command":
            form = f"TOPIC:FIELD:UNIT, the unit one of {', '.join(u for u in SCALES['motors'] if u != 'command')}"
            raise ValueError(f"topics: motors must be {form}; got {topics['motors']}")
        found["motors"] = (topic, *given)
    elif fitting := [topic for topic, kind in types.items() if kind.split("/")[-1] == "Actuators"]:
        found["motors"] = (sorted(fitting)[0], "|".join(FIELDS), "rad/s")
    return found


def _require(topic: str, types: Mapping[str, str], role: str = "", kinds: Collection[str] = ()) -> None:
    if topic not in types:
        raise ValueError(f"has no messages of topic {topic}, only of {', '.join(sorted(types)) or 'none'}")
    kind = types[topic].split("/")[-1]
    if role and kind not in kinds:
        others = [other for other, readers in READERS.items() if kind in readers]
        advice = f'; it can be {others[0]}: topics={{"{others[0]}": "{topic}"}}' if others else ""
        raise ValueError(f"topics: {role} must be of type {', '.join(sorted(kinds))}; {topic} is {kind}{advice}")


def _stamps(messages) -> np.ndarray:
    """Return the time stamps [ns] of the headers if there are any, else of the bag."""
    headers = [getattr(message, "header", None) for _, message in messages]
    if all(header is not None and (header.stamp.sec or header.stamp.nanosec) for header in headers):
        return np.array([header.stamp.sec * 10**9 + header.stamp.nanosec for header in headers if header], np.int64)
    return np.array([at for at, _ in messages], np.int64)


def _numbers(message, field: str):
    """Read a field of a message, or of each of its parts, for example esc_telemetry.rpm."""
    whole, _, part = field.partition(".")
    found = getattr(message, whole, ())
    return [getattr(each, part, None) for each in found] if part else np.ravel(found)


def _motors(topic: str, field: str, messages) -> tuple[np.ndarray, str]:
    fields = field.split("|")
    name = next((name for name in fields if len(_numbers(messages[0], name))), fields[0])
    try:
        rows = [np.asarray(_numbers(message, name), float).ravel() for message in messages]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{topic}: field {name} must contain a number for each motor") from error
    counts = {len(row) for row in rows}
    if len(counts) > 1 or min(counts) < FEWEST_ROTORS:
        known = ", ".join(each for each in vars(messages[0]) if not each.startswith("_"))
        found = f"{', '.join(map(str, sorted(counts)))} numbers, but needs one for each motor; its fields are {known}"
        raise ValueError(f"{topic}: field {name} has {found}")
    return np.stack(rows), name
