"""Twins of every format, written here byte by byte, are read as the flight they hold."""

import gzip
import os
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from surface import refusal
from writers import MOTORS, STATES, bag, crazyflie, failures, usd

from hybrid_jax.flights import check_recording, find_logs, load_logs, read_recording, to_flight
from hybrid_jax.flights.formats import raw
from hybrid_jax.flights.formats.column_map import SCALES, of_unit
from hybrid_jax.flights.formats.raw import Samples, record
from hybrid_jax.vehicle import IRIS


@pytest.mark.parametrize("packed", [False, True])
def test_a_crazyflie_log_is_the_flight_it_holds(flight, written, packed):
    content = crazyflie(flight)
    log = to_flight(read_recording(written(content, packed=packed)), polynomial=(0.0, 65536 / 60))
    np.testing.assert_allclose(log.t, flight.t - flight.t[0], atol=1e-6)
    np.testing.assert_allclose(log.x, flight.x, atol=1e-4)
    np.testing.assert_allclose(log.u[:-1], flight.u[:-1], atol=0.02)


def test_crazyflie_angles_commands_and_accelerations_have_our_signs_and_events_their_own_times(written, flight):
    ones, t = np.ones(5), np.arange(5) * 1000
    columns = {"stateEstimate.roll": 10 * ones, "stateEstimate.pitch": 20 * ones, "stateEstimate.yaw": 0 * ones}
    columns |= {"controller.r_roll": ones, "controller.r_pitch": ones, "controller.r_yaw": ones}
    columns |= {"controller.cmd_thrust": 30000 * ones, "controller.cmd_roll": 0 * ones}
    columns |= {"controller.cmd_pitch": 2000 * ones, "controller.cmd_yaw": 0 * ones}
    columns |= {"stateEstimate.ax": 3 * ones, "stateEstimate.ay": 0 * ones, "stateEstimate.az": 3 * ones}
    signals = read_recording(written(usd(columns, t))).signals
    np.testing.assert_allclose(signals["rates"].values[0], [1, -1, 1])
    # Nose up by 20°: body x points up, so a turn about y (left) by −20°.
    assert signals["attitude"].values[0, 2] < -0.17
    np.testing.assert_allclose(65536 * signals["command"].values[0], [31000, 29000, 29000, 31000])  # M1, M4 in front
    assert signals["specific_force"].axes == ("z",)
    np.testing.assert_allclose(signals["specific_force"].values[0], 9.81 * 5)
    ticks = np.round(flight.t * 1e6).astype(int)
    pwm = {f"pwm.m{i + 1}_pwm": 60 * u[::2] for i, u in enumerate(flight.u.T)}
    gyro = dict(zip(STATES[-3:], np.rad2deg(flight.x[:, 10:]).T, strict=True))
    signals = read_recording(written(usd(gyro, ticks, event=(pwm, ticks[::2])))).signals
    np.testing.assert_allclose(signals["rates"].values, flight.x[:, 10:], atol=1e-5)
    np.testing.assert_allclose(signals["command"].t, flight.t[::2], atol=1e-9)
    np.testing.assert_allclose(signals["command"].values, 60 * flight.u[::2] / 65536, atol=1e-6)


def test_a_crazyflie_log_that_is_cut_off_or_changed_fails(flight, written):
    whole = crazyflie(flight)
    for content in (whole[:-3000], whole[:-9] + b"\0" + whole[-8:], whole + whole):
        (line,) = failures(check_recording(read_recording(written(content)), IRIS), "log")
        assert "CRC-32 is wrong" in line
        assert "records end at 1" in line
    for content in (b"", whole[:2], whole[:60], usd({}, np.zeros(0, int)), gzip.compress(whole)[:-9]):
        refusal(lambda content=content: read_recording(written(content, "flight.bin")), "flight.bin")


def test_numbers_that_wrapped_are_found_and_motors_at_rest_and_beyond_their_limits_fail(flight, written):
    height = np.int16(np.round(1000 * np.linspace(30, 40, len(flight.t))).astype(int) & 0xFFFF)
    columns = {f"stateEstimateZ.{axis}": height for axis in "xyz"}
    ticks = np.round(flight.t * 1e6).astype(int)
    path = written(usd(columns, ticks, dict.fromkeys(columns, "h")))
    refusal(lambda: read_recording(path), path, "stateEstimateZ.x", "32761 to -32767", "at 3.32 s", "16 bits")
    signed = dict(zip(MOTORS, np.int16(np.round(40000 + flight.u.T).astype(int) & 0xFFFF), strict=True))
    path = written(usd(signed, ticks, dict.fromkeys(MOTORS, "h")))
    assert "16-bit number wrapped" in "".join(failures(check_recording(read_recording(path)), "log"))
    refusal(lambda: read_recording(written(usd(signed, ticks % 2**16))), "goes back from", "16 bits of µs began anew")
    rest = {name: np.zeros(len(flight.t), int) for name in MOTORS}
    rpm = {f"rpm.m{i + 1}": u * 30 / np.pi for i, u in enumerate(flight.u.T)}
    jump = {"rpm.m2": np.where(np.arange(len(flight.t)) == 300, 1e6, rpm["rpm.m2"])}
    for changes, words in (
        (rest, "another topic, instance"),
        (rest | {"stateEstimate.z": 0 * flight.t}, "nothing flew"),
        ({name: np.pi / 30 * speeds for name, speeds in rpm.items()}, "read as rpm"),
        (rpm | jump, "rotor_speed of motor 1 is 1.047e+05 at 3 s, must be from 0 to 1100"),
    ):
        recording = read_recording(written(crazyflie(flight, **changes)))
        assert words in failures(check_recording(recording, IRIS), "log")[0]


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_a_bag_is_the_flight_it_holds(flight, tmp_path, plugin):
    path = bag(tmp_path / "run", flight, plugin)
    recording = read_recording(path, topics={"motors": "/rotors:data:rpm"})
    log = to_flight(recording)
    np.testing.assert_allclose(log.x, flight.x[: len(log)], atol=1e-5)
    np.testing.assert_allclose(log.u[:-1], flight.u[: len(log) - 1], rtol=1e-6)
    assert not failures(check_recording(recording, IRIS, 0.01), "log")
    assert any("/rotors" in note for note in read_recording(path).notes)
    refusal(lambda: to_flight(read_recording(path)), path, "no motors", 'topics={"motors"')
    refusal(lambda: read_recording(path, topics={"motors": "/rotors"}), "topics: ", "TOPIC:FIELD:UNIT")
    refusal(lambda: read_recording(path, topics={"motors": "/other:data:rpm"}), "/other", "/odom")
    refusal(lambda: read_recording(path, topics={"wings": "/odom"}), "topics: ", "odometry")
    path = bag(tmp_path / "two", flight[:20], plugin, ("odom", "truth"))
    refusal(lambda: read_recording(path), path, "/odom and /truth have odometry", 'topics={"odometry": "/odom"}')
    assert "position" in read_recording(path, topics={"odometry": "/truth"}).signals


ROTORS = {"motors": "/rotors:data:rpm"}
PAIRS = [("pose", "twist"), ("covered", "velocity_local"), ("bare", "twist"), ("vicon", "velocity_local")]
BAGS = [((*pair, "rotors"), ROTORS) for pair in PAIRS]
BAGS += [(("pose", "speed", "rotors"), ROTORS | {"velocity": "/speed"})]
BAGS += [(("world", "rotors"), ROTORS | {"velocity": "/world"}), (("local", "attitude", "gyro", "rotors"), ROTORS)]
BAGS += [(("odom", "imu", "battery", "motors"), {})]
BAGS += [(("odom", "point", "escs"), {"motors": "/escs:esc_telemetry.rpm:rpm", "pose": "/point"})]


@pytest.mark.parametrize(("names", "topics"), BAGS, ids=lambda each: "_".join(each))
def test_messages_of_every_type_are_read(flight, tmp_path, names, topics):
    """What mavros, Vicon, Gazebo and PX4's own bridge record, each type beside rotors."""
    few = flight[:150]
    for plugin in ("ROS1", "MCAP"):
        recording = read_recording(bag(tmp_path / plugin, few, plugin, names), topics=topics)
        signals = recording.signals
        turned = Rotation.from_quat(np.roll(few.x[:, 3:7], -1, axis=1)).inv().apply(few.x[:, 7:10])
        truth = {"position": few.x[:, :3], "velocity": few.x[:, 7:10], "rates": few.x[:, 10:], "body_velocity": turned}
        truth |= {"rotor_speed": few.u, "voltage": np.full((150, 1), 16.5), "specific_force": 0 * turned + [0, 0, 9.81]}
        for name, values in truth.items():
            if name in signals:
                np.testing.assert_allclose(signals[name].values, values, atol=0.1 if name == "rotor_speed" else 1e-5)
        assert np.abs((signals["attitude"].values * few.x[:, 3:7]).sum(axis=1)).min() > 1 - 1e-7
        assert {"velocity", "body_velocity"} & signals.keys()
        assert {"rates", "voltage", "specific_force"} <= signals.keys() or "imu" not in names


@pytest.mark.parametrize("unit", [*SCALES["motors"]])
def test_motors_of_any_unit_are_read(unit):
    share = np.array([[0.0, 0.3, 0.6, 1.0]])
    number = {"pwm": 1000 + 1000 * share, "dshot": 48 + 1999 * share, "16bit": 65535 * share, "percent": 100 * share}
    speed = {"rpm": 30 / np.pi * share, "rev/s": share / (2 * np.pi)}
    np.testing.assert_allclose(of_unit((number | speed).get(unit, share), unit), share, atol=1e-12)


def test_channels_of_motors_are_chosen_and_other_types_named(flight, tmp_path):
    path = bag(tmp_path / "run", flight[:20], "MCAP", ("pose", "rc"))
    sixteen = read_recording(path, topics={"motors": "/rc:channels:pwm"}, motor_order=(0, 1, 2, 3))
    np.testing.assert_allclose(sixteen.signals["command"].values, flight.u[:20] / 1000, atol=1e-3)
    refusal(lambda: read_recording(path, topics={"odometry": "/pose"}), "must be of type Odometry", "PoseStamped")
    assert not failures(check_recording(sixteen, IRIS), "log")[1:]  # no velocity and no rates


def test_the_compressed_state_and_the_filter_of_a_crazyflie_are_read(flight, written):
    """quatcompress.h: the place of the largest of x, y, z, w in two bits, then a sign and nine bits for each other."""
    columns = {f"stateEstimateZ.{axis}": 1000 * column for axis, column in zip("xyz", flight.x.T, strict=False)}
    columns |= {f"stateEstimateZ.v{axis}": 1000 * flight.x[:, 7 + i] for i, axis in enumerate("xyz")}
    turned = zip(("Roll", "Pitch", "Yaw"), (flight.x[:, 10:] * [1, -1, 1]).T, strict=True)
    columns |= {f"stateEstimateZ.rate{axis}": 1000 * column for axis, column in turned}
    columns = {name: np.round(column).astype(int) for name, column in columns.items()}
    packed = []
    for q in np.roll(flight.x[:, 3:7], -1, axis=1):
        largest = int(np.abs(q).argmax())
        bits = largest
        for i in range(4):
            size = round(511 * abs(q[i]) * 2**0.5)
            bits = bits if i == largest else bits << 10 | ((q[i] < 0) ^ (q[largest] < 0)) << 9 | size
        packed.append(int(bits))
    columns["stateEstimateZ.quat"] = np.array(packed)
    kinds = dict.fromkeys(columns, "h") | {"stateEstimateZ.quat": "I"}
    path = written(usd(columns, np.round(flight.t * 1e6).astype(int), kinds))
    kalman = {f"kalman.state{axis}": column for axis, column in zip("XYZ", flight.x.T, strict=False)}
    kalman |= {f"kalman.q{i}": flight.x[:, 3 + i] for i in range(4)}
    for found in (path, written(usd(kalman, np.round(flight.t * 1e6).astype(int)), "kalman")):
        signals = read_recording(found).signals
        np.testing.assert_allclose(signals["position"].values, flight.x[:, :3], atol=1e-3)
        assert np.abs((signals["attitude"].values * flight.x[:, 3:7]).sum(axis=1)).min() > 1 - 1e-5
        if "rates" in signals:
            np.testing.assert_allclose(signals["rates"].values, flight.x[:, 10:], atol=1e-3)


def test_numbers_beyond_any_flight_and_two_clocks_are_named(flight, tmp_path):
    """A bag holds doubles: 1e10 m is no position, of one sample or of most."""
    x = flight.x[:60].copy()
    x[20, 1] = 1e10
    spoiled = SimpleNamespace(t=flight.t[:60], x=x, u=flight.u[:60])
    recording = read_recording(bag(tmp_path / "one", spoiled, "MCAP"))
    assert len(recording.signals["position"]) == 59
    assert any("position is not a number in 1 samples, the first at 0.2 s" in note for note in recording.notes)
    x[20:55, 1] = 1e10
    path = bag(tmp_path / "most", spoiled, "MCAP")
    refusal(lambda: read_recording(path), path, "/odom", "y is 1e+10 at 0.2 s")
    # Stamps since boot beside those since 1970, as of mavros without a time sync.
    parts = {"rates": (flight.t, flight.x[:, 10:], "/imu"), "position": (flight.t + 1.7e9, flight.x[:, :3], "/odom")}
    samples = {name: Samples(t, values, source) for name, (t, values, source) in parts.items()}
    (line,) = [line for line in failures(check_recording(record("bag", samples)), "log") if "no time in common" in line]
    assert "/odom from 1700000000 to 1700000012 s" in line


@pytest.mark.parametrize("stray", [0, 600, -1])
def test_a_sample_that_tells_nothing_is_left_out_and_said(flight, written, stray):
    """A time stamp of zero, or a motion capture that lost the vehicle; where more than half is lost, it is refused."""
    ticks = 10**9 + np.round(flight.t * 1e6).astype(int)
    ticks[stray] = 0
    names = dict(zip(STATES, flight.x[:, [0, 1, 2, 7, 8, 9, 3, 4, 5, 6, 10, 11, 12]].T, strict=True))
    lost = np.arange(len(ticks)) % 400 < 10
    names |= {name: np.where(lost, 0.0, names[name]) for name in STATES if name.startswith("stateEstimate.q")}
    path = written(usd(names, ticks))
    recording = read_recording(path)
    assert len(recording.signals["rates"]) == len(ticks) - 1
    assert len(recording.signals["attitude"]) == len(ticks) - lost.sum() - (not lost[stray])
    assert len(recording.signals["attitude"].gaps()) == 2
    for words in ("1 samples with a time far", "attitude is not a rotation in"):
        assert any(words in note for note in recording.notes)
    nothing = names | {name: 0 * flight.t for name in STATES if name.startswith("stateEstimate.q")}
    refusal(lambda: read_recording(written(usd(nothing, ticks))), "norm 0, must be 1")


@pytest.mark.parametrize("name", ["00000012.BIN", "00000012.log", "sess001.px4log", "flight.tlog", "logs.zip"])
def test_formats_that_are_not_read_are_named_with_a_way_out(written, tmp_path, name):
    starts = {"BIN": b"\xa3\x95\x80\x80", "log": b"FMT, 128, 89, FMT, BBnNZ, Type", "zip": b"PK\x03\x04"}
    ending = name.split(".")[1]
    path = written(starts.get(ending, b"abcd") + bytes(100), name)
    words = dict.fromkeys(("BIN", "log"), "mavlogdump.py --format csv")
    words |= {"px4log": "log .ulg", "tlog": "own card", "zip": "unpack it"}
    refusal(lambda: read_recording(path), path, words[ending])
    assert words[ending] in find_logs(tmp_path)[1][path]


def test_pipes_links_and_bombs_neither_hang_nor_fill_the_memory(tmp_path):
    os.mkfifo(tmp_path / "pipe.ulg")
    (tmp_path / "nowhere.csv").symlink_to(tmp_path / "none")
    (tmp_path / "loop.csv").symlink_to(tmp_path / "loop.csv")
    (tmp_path / "zeros.ulg.gz").write_bytes(gzip.compress(b"ULog" + bytes(1 << 25)))
    _, left = find_logs(tmp_path)
    assert {path.name for path in left} >= {"pipe.ulg", "nowhere.csv", "loop.csv"}
    for name in ("pipe.ulg", "nowhere.csv", "loop.csv", "zeros.ulg.gz"):
        refusal(lambda name=name: read_recording(tmp_path / name), name)
    refusal(lambda: read_recording(tmp_path / "zeros.ulg.gz"), "unpacks to more than 16 MiB")


@pytest.mark.parametrize("plugin", ["ROS1", "MCAP"])
def test_messages_of_a_bag_are_limited_as_a_packed_log_is(flight, tmp_path, monkeypatch, plugin):
    path = bag(tmp_path / "run", flight[:60], plugin)
    for name, limit in (("RATIO", 0.1), ("SMALL", 0)):
        read_recording(path, topics={"motors": "/rotors:data:rpm"})
        monkeypatch.setattr(raw, name, limit)
    refusal(lambda: read_recording(path), path, "unpacks to more than 0 MiB")


def test_a_folder_of_all_kinds_says_what_it_reads(flight, written, tmp_path):
    written(crazyflie(flight), "log00")
    written(b"", "notes.txt")
    written(b"\x7fELF", "firmware.bin")
    (tmp_path / "more").mkdir()
    bag(tmp_path / "run", flight[:20], "MCAP")
    logs, left = find_logs(tmp_path)
    assert [path.name for path in logs] == ["log00", "run"]
    said = {"firmware.bin": "not a supported format", "more": "a folder; give it by itself", "notes.txt": "empty"}
    assert {path.name: why for path, why in left.items()} == said
    refusal(lambda: load_logs(tmp_path / "more"), "contains no flights")
