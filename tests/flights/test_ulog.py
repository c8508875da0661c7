"""A ULog written here, byte by byte, is read as the flight it holds (docs.px4.io, "ULog File Format", version 1)."""

import gzip
import struct
from collections import Counter

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from surface import refusal
from writers import OUTPUTS, PX4_STATES, START, commands, escs, failures, message, outputs, stamped, stamps, ulog

from hybrid_jax.flights import Recording, check_recording
from hybrid_jax.flights.attitude import BODIES, WORLDS
from hybrid_jax.flights.conversion import to_flight, what_to_log
from hybrid_jax.flights.formats import raw
from hybrid_jax.flights.formats.ulog import SOURCES
from hybrid_jax.flights.load import read_recording, reordered
from hybrid_jax.vehicle import IRIS

pytest.importorskip("pyulog", reason="reading ULog needs the extra `logs`")


@pytest.mark.parametrize("packed", [False, True])
def test_a_flight_with_esc_rpm_is_read(flight, topics, written, packed):
    t = flight.t - flight.t[0]
    content = ulog(topics | {"esc_status": escs(t, flight.u)})
    log = to_flight(read_recording(written(gzip.compress(content) if packed else content)))
    np.testing.assert_allclose(np.diff(log.t), 0.01, atol=1e-9)
    truth = CubicSpline(t, flight.x)(log.t + 0.003)
    # Linear between samples: ẍ / (8 · 50²) of position and velocity, ω̈ / (8 · 200²) of rates; slerp of attitude.
    np.testing.assert_allclose(log.x[:, 3:7], truth[:, 3:7], atol=2e-4)
    np.testing.assert_allclose(log.x[:, [0, 1, 2, 7, 8, 9]], truth[:, [0, 1, 2, 7, 8, 9]], atol=5e-3)
    np.testing.assert_allclose(log.x[:, 10:], truth[:, 10:], atol=5e-3)
    # A sample at 3 ms finds 7 ms of one held value and 3 ms of the next.
    mean = 0.7 * flight.u[:-1] + 0.3 * flight.u[1:]
    np.testing.assert_allclose(log.u[:-1], mean[: len(log) - 1], atol=0.1)


@pytest.mark.parametrize("escs_too", [False, True])
def test_commands_are_shares_that_the_polynomial_converts(flight, topics, written, escs_too):
    """Also if ESCs report zero."""
    t = flight.t - flight.t[0] + 0.003
    zeros = {"esc_status": escs(t, 0 * flight.u)} if escs_too else {}
    path = written(topics | zeros | {"actuator_motors": commands(t, flight.u)})
    log = to_flight(reordered(read_recording(path), (2, 0, 3, 1)), polynomial=(100.0, 1000.0))
    np.testing.assert_allclose(log.u[:-1], flight.u[: len(log) - 1][:, [2, 0, 3, 1]], rtol=1e-5)
    refusal(lambda: to_flight(read_recording(path)), path, "actuator_motors", "polynomial=")
    refusal(lambda: reordered(read_recording(path), (0, 1, 2, 2)), path, "motor_order must")
    refusal(lambda: to_flight(read_recording(path), dt=0.0), "dt must be")


def test_old_logs_hold_pwm_and_the_rates_beside_the_attitude(flight, topics, written):
    """PX4 1.6: no timestamp_sample, rates in vehicle_attitude, commands in µs, 1000 … 2000 by default."""
    t = flight.t - flight.t[0]
    form = "uint64_t timestamp;float rollspeed;float pitchspeed;float yawspeed;float[4] q;"
    rows = zip(stamps(t), flight.x[:, 10:] @ BODIES["FRD"], flight.x[:, 3:7], strict=True)
    old = {"vehicle_attitude": [struct.pack("<Q7f", at, *omega, *q) for at, omega, q in rows]}
    six = np.concatenate([1000 + flight.u, np.full((len(t), 2), 900.0)], axis=1)
    old["actuator_outputs"], formats = outputs(t, six), OUTPUTS | {"vehicle_attitude": form}
    recording = read_recording(written(ulog(old, formats)))
    np.testing.assert_allclose(recording.signals["rates"].values, flight.x[:, 10:], atol=1e-5)
    np.testing.assert_allclose(recording.signals["command"].values, flight.u / 1000, atol=1e-6)
    refusal(lambda: to_flight(recording, polynomial=(0, 1000.0)), "no position and no velocity", "logger_topics.txt")


# Of PWM, DShot, UAVCAN, and a share.
@pytest.mark.parametrize(("rest", "full"), [(1000.0, 2000.0), (0.0, 1999.0), (0.0, 8191.0), (0.0, 1.0)])
@pytest.mark.parametrize("number", [0, 1])
def test_motors_are_found_in_any_instance_and_unit(flight, topics, written, rest, full, number):
    """PX4 before 1.13 numbers outputs by driver; that of the other driver is constant."""
    t, share = flight.t - flight.t[0], flight.u / 1100
    share[:50] = 0.05  # idle on the ground
    instances = {("actuator_outputs", number): outputs(t, rest + share * (full - rest))}
    instances |= {("actuator_outputs", 1 - number): outputs(t, 0 * share + 900)}
    recording = read_recording(written(ulog(topics | instances, OUTPUTS)))
    np.testing.assert_allclose(recording.signals["command"].values, share, atol=1e-5)
    assert any(f"instance {1 - number} is left out" in note for note in recording.notes)


@pytest.mark.parametrize(("board", "unit"), [("PX4_SITL", np.pi / 30), ("PX4_SITL", 1.0), ("PX4_FMU_V5", np.pi / 30)])
def test_rotor_speeds_of_a_simulator_may_be_in_radians(flight, topics, written, board, unit):
    """Gazebo's esc_rpm was in rad/s until PX4-Autopilot #22721; no rotor of a simulated vehicle is that slow."""
    t = flight.t - flight.t[0]
    speeds = escs(t, flight.u * np.pi / 30 / unit)
    recording = read_recording(written(ulog(topics | {"esc_status": speeds}, hardware=board)))
    np.testing.assert_allclose(recording.signals["rotor_speed"].values[:, :4], flight.u, atol=1)
    assert any("rad/s" in note for note in recording.notes) == (unit == 1.0)


def test_a_moving_motor_is_never_dropped_and_another_airframe_is_refused(flight, topics, written):
    t = flight.t - flight.t[0]
    moving = np.concatenate([flight.u[:, :2]] * 3, axis=1)
    rows = stamped(t, np.concatenate([moving / 2000, np.full((len(t), 6), np.nan)], axis=1))
    path = written(ulog(topics | {"actuator_motors": rows}, parameters={"MAV_TYPE": 2, "SYS_AUTOSTART": 4001}))
    assert read_recording(path).rotors == 6
    (line,) = failures(check_recording(read_recording(path), IRIS), "log")
    assert "6 motors are logged" in line
    assert "motor_order=(0, 1, 2, 3)" in line
    assert not failures(check_recording(reordered(read_recording(path), (0, 1, 2, 3)), IRIS), "log")
    path = written(ulog(topics | {"actuator_motors": rows}, parameters={"MAV_TYPE": 2, "SYS_AUTOSTART": 13014}))
    assert any("VTOL (SYS_AUTOSTART 13014)" in line for line in failures(check_recording(read_recording(path)), "log"))


@pytest.mark.parametrize("version", [(1, 9), (1, 12), (1, 14)], ids=str)
def test_advice_for_the_next_flight_is_complete_for_its_version(version):
    """A list of topics takes the place of PX4's profile, so what it lacks is lost."""
    facts = {"format": "PX4 ULog", "program": f"PX4 {version[0]}.{version[1]}.0 on PX4_FMU_V5"}
    said = what_to_log(Recording("log", {}, (), facts))
    listed = {line.split()[0] for line in said.split("'")[1].split(r"\n") if line}
    assert listed >= {"vehicle_local_position", "vehicle_attitude", "sensor_combined", "battery_status", "esc_status"}
    assert ("actuator_motors" in listed, "vehicle_angular_velocity" in listed) == (version > (1, 12), version > (1, 9))
    assert "actuator_outputs" in listed


@pytest.mark.parametrize(
    ("quantity", "topic", "fields"), [(name, *place) for name, places in SOURCES.items() for place in places]
)
def test_every_topic_of_a_quantity_is_read_in_its_frame(written, quantity, topic, fields):
    values = np.random.default_rng(0).normal(size=(50, len(fields)))
    values /= np.linalg.norm(values, axis=1, keepdims=True) if quantity == "attitude" else 1
    counts = Counter(field.split("[")[0] for field in fields)
    form = "".join(f"float[{n}] {name};" if "[" in " ".join(fields) else f"float {name};" for name, n in counts.items())
    formats = {topic: f"uint64_t timestamp;uint64_t timestamp_sample;{form}"}
    content = ulog({topic: stamped(0.01 * np.arange(50), values)}, formats)
    found = read_recording(written(content)).signals[quantity].values
    own = raw.attitude(values, "NED", "FRD") if quantity == "attitude" else values
    frame = WORLDS["NED"] if quantity in ("position", "velocity") else BODIES["FRD"]
    np.testing.assert_allclose(found, own @ frame.T if len(fields) == 3 else own, atol=1e-6)


def test_what_the_estimator_calls_invalid_and_resets_are_said_and_a_dropout_becomes_a_gap(written, flight, topics):
    form = "uint64_t timestamp;float x;float y;float z;uint8_t xy_valid;uint8_t z_valid;uint8_t z_reset_counter;"
    rows = [struct.pack("<Q3f3B", START + 10_000 * i, i, 0, 0, i >= 10, 1, i >= 30) for i in range(50)]
    content = ulog({"vehicle_local_position": rows}, {"vehicle_local_position": form})
    recording = read_recording(written(content + message("O", struct.pack("<H", 120))))
    assert len(recording.signals["position"]) == 40
    for words in ("not valid in 10 of 50", "reset the position (z_reset_counter) at 0.3 s", "longest of 120 ms"):
        assert any(words in note for note in recording.notes)
    t = flight.t - flight.t[0]
    holed = topics["vehicle_attitude"][:500] + topics["vehicle_attitude"][550:]  # 0.4 s from 4.003 s on
    log = to_flight(read_recording(written(topics | {"vehicle_attitude": holed, "esc_status": escs(t, flight.u)})))
    intervals = np.diff(log.t)
    assert intervals.max() == pytest.approx(0.4, abs=0.02)
    assert np.count_nonzero(intervals > 0.015) == 1
    truth = CubicSpline(t, flight.x)(log.t + 0.003)
    np.testing.assert_allclose(log.x[:, 3:7], truth[:, 3:7], atol=2e-4)


@pytest.mark.parametrize("missing", [*PX4_STATES, "esc_status"])
def test_a_missing_topic_is_named_and_samples_without_content_are_refused(flight, topics, written, missing):
    motors = {"esc_status": escs(flight.t - flight.t[0], flight.u)}
    path = written({name: samples for name, samples in (topics | motors).items() if name != missing})
    quantity = dict(zip((*PX4_STATES, "esc_status"), ("position", "attitude", "rates", "motors"), strict=True))[missing]
    refusal(lambda: to_flight(read_recording(path)), path, f"no {quantity}", "logger_topics.txt", f"{missing} ")
    zero = stamped(np.arange(0.0, 5, 0.01), np.zeros((500, 4)))
    refusal(lambda: read_recording(written(topics | {"vehicle_attitude": zero})), "vehicle_attitude", "norm")
    bad = stamped(np.arange(0.0, 5, 0.01), np.full((500, 3), np.nan))
    refusal(lambda: read_recording(written(topics | {"vehicle_angular_velocity": bad})), "xyz[0]", "x is nan at 0 s")


def test_a_log_that_was_cut_off_is_read_and_fails_and_a_clock_that_jumps_is_refused_or_a_gap(flight, topics, written):
    whole = ulog(topics | {"esc_status": escs(flight.t - flight.t[0], flight.u)})
    (line,) = failures(check_recording(read_recording(written(whole[:-500])), IRIS), "log")
    assert "ends in the middle of a message, after 11" in line
    assert 'failed="warn"' in line
    rates, late = topics["vehicle_angular_velocity"], stamped(np.arange(0.0, 1, 0.005) + 3600, np.ones((200, 3)))
    recording = read_recording(written(topics | {"vehicle_angular_velocity": rates + late}))
    (line,) = [line for line in failures(check_recording(recording), "log") if "longest gap" in line]
    assert "vehicle_angular_velocity" in line
    assert "split the file" in line
    back = rates[:1000] + stamped(np.arange(0.0, 1, 0.005), np.ones((200, 3)))
    content = ulog({"vehicle_angular_velocity": back}, ordered=False)
    refusal(lambda: read_recording(written(content)), "flight.log", "vehicle_angular_velocity", "time goes back from")
