"""Files of every format, written byte by byte, that hold the constructed flight."""

import struct
import zlib

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from hybrid_jax.flights.attitude import BODIES, WORLDS
from hybrid_jax.flights.checks.consistency import FAILS
from hybrid_jax.vehicle import QUATERNION

STATES = ["stateEstimate.x", "stateEstimate.y", "stateEstimate.z", "stateEstimate.vx", "stateEstimate.vy"]
STATES += ["stateEstimate.vz", *(f"stateEstimate.q{axis}" for axis in "wxyz"), "gyro.x", "gyro.y", "gyro.z"]
MOTORS = [f"motor.m{i}" for i in range(1, 5)]


def usd(columns, ticks, kinds=None, event=None):
    """Bytes of a µSD log: name → values, and times in µs; of another event type at its own times, too."""
    names, kinds = list(columns), kinds or {}
    head = struct.pack("<BHHH", 0xBC, 2, 1 + bool(event), 7) + b"fixedFrequency\0" + struct.pack("<H", len(names))
    head += b"".join(f"{name}({kinds.get(name, 'f')})\0".encode() for name in names)
    form = "<HQ" + "".join(kinds.get(name, "f") for name in names)
    rows = zip(ticks.tolist(), *(np.asarray(columns[name]).tolist() for name in names), strict=True)
    records = [struct.pack(form, 7, *row) for row in rows]
    if event:
        head += struct.pack("<H", 9) + b"own\0" + struct.pack("<H", len(event[0]))
        head += b"".join(f"{name}(f)\0".encode() for name in event[0])
        own = zip(event[1].tolist(), *(np.asarray(values).tolist() for values in event[0].values()), strict=True)
        records += [struct.pack("<HQ" + "f" * len(event[0]), 9, *row) for row in own]
    body = head + b"".join(records)
    return body + struct.pack("<I", zlib.crc32(body))


def crazyflie(flight, **changes):
    x = flight.x.copy()
    x[:, 10:] *= 180 / np.pi
    columns = dict(zip(STATES, x[:, [0, 1, 2, 7, 8, 9, 3, 4, 5, 6, 10, 11, 12]].T, strict=True))
    motors = np.round(60 * flight.u).astype(int)
    columns |= dict(zip(MOTORS, motors.T, strict=True)) | {"pm.vbatMV": 3700 + 0 * flight.t} | changes
    return usd(columns, 10**9 + np.round(flight.t * 1e6).astype(int), dict.fromkeys(MOTORS, "H"))


HEADER = "std_msgs/Header header\n"
MESSAGES = {  # of packages that no store of types has
    "px4_msgs/msg/VehicleAttitude": "uint64 timestamp\nfloat32[4] q\n",
    "px4_msgs/msg/VehicleAngularVelocity": "uint64 timestamp\nfloat32[3] xyz\n",
    "px4_msgs/msg/VehicleLocalPosition": "uint64 timestamp\n"
    + "".join(f"float32 {name}\n" for name in ("x", "y", "z", "vx", "vy", "vz")),
    "mav_msgs/msg/Actuators": HEADER + "float64[] angles\nfloat64[] angular_velocities\nfloat64[] normalized\n",
    "mavros_msgs/msg/ESCTelemetryItem": HEADER + "int32 rpm\nfloat32 voltage\n",
    "mavros_msgs/msg/ESCTelemetry": HEADER + "mavros_msgs/ESCTelemetryItem[] esc_telemetry\n",
    "mavros_msgs/msg/RCOut": HEADER + "uint16[] channels\n",
}


def messages(store, flight):
    """Topic → message for each sample: what mavros, Vicon, Gazebo, PX4's own bridge and others record."""
    kinds, zeros = {name.split("/")[-1]: kind for name, kind in store.types.items()}, np.zeros(36)
    kinds["Time"] = store.types["builtin_interfaces/msg/Time"]
    vector, layout = kinds["Vector3"], kinds["MultiArrayLayout"](dim=[], data_offset=0)
    turns = Rotation.from_quat(np.roll(flight.x[:, 3:7], -1, axis=1))
    back, rolled = turns.inv().apply(flight.x[:, 7:10]), turns.apply(flight.x[:, 10:])
    body, world = BODIES["FRD"], WORLDS["NED"]
    turned = np.roll(Rotation.from_matrix(world @ turns.as_matrix() @ body).as_quat(), 1, axis=1).astype(np.float32)
    for i, (t, x, u) in enumerate(zip(flight.t, flight.x, flight.u, strict=True)):
        at = 10**18 + round(t * 1e9)
        stamp = kinds["Time"](sec=at // 10**9, nanosec=at % 10**9)
        header = kinds["Header"](*([i] if "seq" in kinds["Header"].__dataclass_fields__ else []), stamp, "map")
        p, q, v, w = x[:3], x[3:7], x[7:10], x[10:]
        pose = kinds["Pose"](kinds["Point"](*p), kinds["Quaternion"](*q[1:], q[0]))
        covered = kinds["PoseWithCovariance"](pose, zeros)

        def twist(linear, angular):
            return kinds["TwistWithCovariance"](kinds["Twist"](vector(*linear), vector(*angular)), zeros)

        (ned, vned), us = np.stack([p @ world, v @ world]).astype(np.float32).tolist(), at // 1000
        imu = (pose.orientation, zeros[:9], vector(*w), zeros[:9], vector(0.0, 0.0, 9.81), zeros[:9])
        rpm = np.round(u * 30 / np.pi).astype(int).tolist()
        channels = np.concatenate([np.round(1000 + u), np.zeros(12)]).astype(np.uint16)
        odometry = kinds["Odometry"](header, "", covered, twist(back[i], w))
        yield (
            at,
            {
                "odom": odometry,
                "truth": odometry,
                "world": kinds["Odometry"](header, "", covered, twist(v, rolled[i])),
                "imu": kinds["Imu"](header, *imu),
                "pose": kinds["PoseStamped"](header, pose),
                "covered": kinds["PoseWithCovarianceStamped"](header, covered),
                "bare": pose,
                "vicon": kinds["TransformStamped"](header, "body", kinds["Transform"](vector(*p), pose.orientation)),
                "velocity_local": kinds["TwistStamped"](header, twist(v, w).twist),
                "twist": kinds["TwistWithCovarianceStamped"](header, twist(v, w)),
                "speed": kinds["Vector3Stamped"](header, vector(*v)),
                "battery": kinds["BatteryState"](header, 16.5, *6 * [0.0], 0, 0, 0, True, zeros[:0], zeros[:0], "", ""),
                "local": kinds["VehicleLocalPosition"](us, *ned, *vned),
                "attitude": kinds["VehicleAttitude"](us, turned[i].copy()),
                "gyro": kinds["VehicleAngularVelocity"](us, (w @ body).astype(np.float32)),
                "motors": kinds["Actuators"](header, np.zeros(0), u.copy(), np.zeros(0)),
                "rc": kinds["RCOut"](header, channels),
                "escs": kinds["ESCTelemetry"](header, [kinds["ESCTelemetryItem"](header, each, 16.0) for each in rpm]),
                "point": kinds["PointStamped"](header, kinds["Point"](*p)),
                "rotors": kinds["Float64MultiArray"](layout, u * 30 / np.pi),
            },
        )


def bag(folder, flight, plugin, names=("odom", "imu", "rotors")):
    """A bag of ROS 2, or with the plugin ROS1 of ROS 1, with these topics of `messages`; rotors are in rpm."""
    rosbag1, rosbag2 = pytest.importorskip("rosbags.rosbag1"), pytest.importorskip("rosbags.rosbag2")
    typesys, first = pytest.importorskip("rosbags.typesys"), plugin == "ROS1"
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if first else typesys.Stores.ROS2_HUMBLE)
    for name, text in MESSAGES.items():
        store.register(typesys.get_types_from_msg(text, name))
    if first:
        folder, writer = folder.with_suffix(".bag"), rosbag1.Writer(folder.with_suffix(".bag"))
    else:
        writer = rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin[plugin])
    lines, pack = {}, store.serialize_ros1 if first else store.serialize_cdr
    with writer:
        for at, found in messages(store, flight):
            for name in names:
                kind = found[name].__msgtype__
                lines[name] = lines.get(name) or writer.add_connection(f"/{name}", kind, typestore=store)
                writer.write(lines[name], at, pack(found[name], kind))
    return folder


def varint(value):
    value, found = (value << 1) ^ (value >> 31), b""
    while value > 127:
        found, value = found + bytes([value & 127 | 128]), value >> 7
    return found + bytes([value])


def blackbox(flight, ended=True, events=b"", headers=(), digital=True):
    """Bytes of a blackbox log of intra frames alone, of signed numbers."""
    names = ["loopIteration", "time", *(f"gyroADC[{i}]" for i in range(3)), *(f"accSmooth[{i}]" for i in range(3))]
    names += ["vbatLatest", *(f"motor[{i}]" for i in range(4)), *(f"eRPM[{i}]" for i in range(4))]
    zeros = ",".join("0" * len(names))
    head = ["Product:Blackbox flight data recorder by Nicholas Sherlock", "Data version:2", "I interval:1"]
    head += ["P interval:1", "Firmware type:Cleanflight", "Firmware revision:Betaflight 4.4.0", "minthrottle:1070"]
    head += [f"Field I name:{','.join(names)}", f"Field I signed:{zeros}", f"Field I predictor:{zeros}"]
    head += [f"Field I encoding:{zeros}", f"Field P predictor:{zeros}", f"Field P encoding:{zeros}"]
    head += ["gyro_scale:0x3f800000", "acc_1G:2048", "vbatref:1600", "vbatcellvoltage:330,350,430"]
    head += [f"motorOutput:{'48,2047' if digital else '1000,2000'}", "motor_poles:14"]
    content = b"".join(f"H {line}\n".encode() for line in [*head, *headers])
    for i, (t, x, u) in enumerate(zip(flight.t, flight.x, flight.u, strict=True)):
        row = [i, 10**6 + round(t * 1e6), *(x[10:] * 180 / np.pi), 0, 0, 2048, 1650]
        row += [*(48 + u if digital else 1000 + u), *(u * 30 / np.pi * 7 / 100)]
        content += b"I" + b"".join(varint(round(value)) for value in row)
    return content + events + (b"E\xffEnd of log\0" if ended else b"")


FORMATS = {
    "vehicle_local_position": "uint64_t timestamp;uint64_t timestamp_sample;"
    "float x;float y;float z;float vx;float vy;float vz;",
    "vehicle_attitude": "uint64_t timestamp;uint64_t timestamp_sample;float[4] q;",
    "vehicle_angular_velocity": "uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz;",
    "actuator_motors": "uint64_t timestamp;uint64_t timestamp_sample;float[12] control;",
    "esc_status": "uint64_t timestamp;esc_report[8] esc;",
    "esc_report": "uint64_t timestamp;int32_t esc_rpm;",
}
PX4_STATES = ("vehicle_local_position", "vehicle_attitude", "vehicle_angular_velocity")
OUTPUTS = {"actuator_outputs": "uint64_t timestamp;uint32_t noutputs;float[16] output;"}
START = 12_000_000  # µs since boot


def message(kind, payload):
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def ulog(topics, formats=None, parameters=None, ordered=True, hardware=""):
    """Bytes of a log: topic, or topic and instance, → packed samples, each of which begins with its time."""
    parts = [b"ULog\x01\x12\x35\x01", struct.pack("<Q", START), message("B", bytes(40))]
    parts += [message("F", f"{name}:{fields}".encode()) for name, fields in (FORMATS | (formats or {})).items()]
    for name, value in (parameters or {}).items():
        key = f"int32_t {name}".encode()
        parts.append(message("P", bytes([len(key)]) + key + struct.pack("<i", value)))
    key = f"char[{len(hardware)}] ver_hw".encode()
    parts += [message("I", bytes([len(key)]) + key + hardware.encode())] * bool(hardware)
    named = [(name, 0) if isinstance(name, str) else name for name in topics]
    parts += [message("A", struct.pack("<BH", number, at) + name.encode()) for at, (name, number) in enumerate(named)]
    data = [(sample[:8], at, sample) for at, samples in enumerate(topics.values()) for sample in samples]
    for _, at, sample in sorted(data, key=lambda item: struct.unpack("<Q", item[0]) if ordered else 0):
        parts.append(message("D", struct.pack("<H", at) + sample))
    return b"".join(parts)


def stamps(times):
    return (START + np.round(times * 1e6)).astype(int).tolist()


def stamped(times, values, delay=0):
    """Samples of floats whose message came `delay` µs after what was measured."""
    rows = zip(stamps(times), values, strict=True)
    return [struct.pack(f"<QQ{len(row)}f", stamp + delay, stamp, *row) for stamp, row in rows]


def px4_topics(flight, rate=50):
    """States of a flight as PX4 logs them: NED and FRD, position at a rate in Hz, attitude at 125 Hz, gyro at 200."""
    t = flight.t - flight.t[0]
    body, world = BODIES["FRD"], WORLDS["NED"]

    def at(rate, columns):
        times = np.arange(0.003, t[-1], 1 / rate)
        return times, CubicSpline(t, flight.x[:, columns])(times)

    times, moving = at(rate, [0, 1, 2, 7, 8, 9])
    local = stamped(times, np.concatenate([moving[:, :3] @ world, moving[:, 3:] @ world], axis=1), delay=4000)
    times, q = at(125, QUATERNION)
    turned = Rotation.from_matrix(world.T @ Rotation.from_quat(np.roll(q, -1, axis=1)).as_matrix() @ body)
    attitude = stamped(times, np.roll(turned.as_quat(), 1, axis=1), delay=2000)
    times, omega = at(200, slice(10, 13))
    return dict(zip(PX4_STATES, (local, attitude, stamped(times, omega @ body)), strict=True))


def escs(t, u):
    rpm = np.round(np.concatenate([u, 0 * u], axis=1) * 30 / np.pi).astype(int)
    rows = zip(stamps(t), rpm.tolist(), strict=True)
    return [struct.pack("<Q", at) + b"".join(struct.pack("<Qi", at, speed) for speed in row) for at, row in rows]


def commands(t, u):
    rest = np.full((len(u), 8), np.nan)
    return stamped(t, np.concatenate([(u - 100) / 1000, rest], axis=1))


def outputs(t, values):
    rows = np.concatenate([values, np.zeros((len(t), 16 - values.shape[1]))], axis=1)
    return [struct.pack("<QI16f", at, 16, *row) for at, row in zip(stamps(t), rows.tolist(), strict=True)]


def column_map(**signals):
    """A map of the names and the unit of each signal, in the frames of the library."""
    text = 'frames = {world = "ENU", body = "FLU", velocity = "world"}\n'
    for name, (columns, unit) in signals.items():
        text += f'{name} = {{columns = {columns.split()}, unit = "{unit}"}}\n'
    return text


MAP = """
frames = {world = "NED", body = "FRD", velocity = "body"}
time = {columns = ["stamp"], unit = "us"}
position = {columns = ["x", "y", "z"], unit = "mm"}
attitude = {columns = ["q1", "q2", "q3", "q4"], unit = "xyzw"}
velocity = {columns = ["u", "v", "w"], unit = "cm/s"}
body_rates = {columns = ["p", "q", "r"], unit = "deg/s"}
motors = {columns = ["m3", "m1", "m4", "m2"], unit = "rpm"}
[format]
delimiter = ";"
"""


def foreign(flight):
    """The flight as a logger in NED, FRD and the units of MAP writes it, by name of column."""
    world, body = WORLDS["NED"], BODIES["FRD"]
    to_world = Rotation.from_quat(np.roll(flight.x[:, 3:7], -1, axis=1))
    attitude = Rotation.from_matrix(world.T @ to_world.as_matrix() @ body)
    u = flight.u
    command = (u - 100) / 1000
    squared = (-200 + np.sqrt(200**2 + 4 * 800 * (u - 50))) / 1600
    yaw, pitch, roll = attitude.as_euler("ZYX", degrees=True).T
    columns = {"stamp": flight.t * 1e6 + 7e9, "roll": roll, "pitch": pitch, "yaw": yaw}
    columns |= dict(zip("xyz", 1000 * world.T @ flight.x[:, :3].T, strict=True))
    columns |= dict(zip(("q1", "q2", "q3", "q4"), attitude.as_quat().T, strict=True))
    columns |= dict(zip("uvw", 100 * body @ to_world.inv().apply(flight.x[:, 7:10]).T, strict=True))
    columns |= dict(zip("pqr", np.rad2deg(body @ flight.x[:, 10:].T), strict=True))
    for name, motors in (("rpm", u * 30 / np.pi), ("affine", command), ("quadratic", squared)):
        columns |= dict(zip((f"{name}_{m}" for m in ("m3", "m1", "m4", "m2")), motors.T, strict=True))
    return columns


def table_of(columns, motors="rpm"):
    """The text of such a log, with one kind of motors."""
    names = [name.removeprefix(f"{motors}_") for name in columns]
    rows = [";".join(map(repr, row)) for row in np.column_stack(list(columns.values())).tolist()]
    return "\n".join([";".join(names), *rows])


def failures(checks, name):
    """Each failed check as one line."""
    return [f"{name}: {check.name}: {check.suggestion}" for check in checks if check.verdict == FAILS]
