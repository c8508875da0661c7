"""Resample a recording, whose signals have their own times, to the samples of a flight."""

import re
from collections.abc import Sequence
from functools import reduce

import numpy as np
from jaxtyping import Float

from hybrid_jax import checks
from hybrid_jax.flights.attitude import interpolate, interpolate_attitude, mean_of_held, rotation_of
from hybrid_jax.flights.formats.csv import MAX_ROWS
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.recording import GAP, ROTOR_UNITS, Recording, Signal
from hybrid_jax.vehicle import MOST_ROTORS

DT = 0.01  # s, for logs whose signals have different times
STATES = ("position", "velocity", "attitude", "rates")
WHOLE = 0.9  # share of complete rows of a CSV file above which their times are used
# What to log, by format, ready to paste.
CRAZYFLIE = (
    *(f"stateEstimate.{each}" for each in ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz")),
    *(f"{group}.{axis}" for group in ("gyro", "acc") for axis in "xyz"),
    *(f"motor.m{i}" for i in range(1, 5)),
    "pm.vbatMV",
)
ADVICE = {
    "Crazyflie µSD": f"put below on:fixedFrequency in config.txt of the card: {' '.join(CRAZYFLIE)}",
    "ROS bag": 'record odometry, IMU and motors, and name them: topics={"motors": "/TOPIC:FIELD:UNIT"}',
    "Betaflight blackbox": "blackbox has no fields for them; use it to identify thrust, inertia and lag",
    "CSV": 'name the columns in a column map: columns="MAP.toml"',
}
# Topics of PX4 with their logging interval [ms], 0 for every sample; and the version that introduced a topic.
PX4_TOPICS = {"vehicle_local_position": 0, "vehicle_attitude": 0, "sensor_combined": 5, "battery_status": 100}
PX4_TOPICS |= {"vehicle_angular_velocity": 5, "vehicle_acceleration": 5, "actuator_motors": 5, "actuator_outputs": 5}
PX4_TOPICS |= {"esc_status": 5, "vehicle_status": 100}
SINCE = {"vehicle_angular_velocity": (1, 10), "vehicle_acceleration": (1, 11), "actuator_motors": (1, 13)}


def to_flight(recording: Recording, dt: float = DT, polynomial: Sequence[float] = ()) -> FlightLog:
    """Resample a recording at intervals of dt [s] while all its signals exist. A gap in one signal is a gap in all.

    States are interpolated linearly and attitudes spherically; rotor speeds are averaged over each interval.

    Args:
        recording: the log as it was read.
        dt: interval between samples [s].
        polynomial: rotor speed [rad/s] = Σ polynomial[i] commandⁱ, for commands from 0 to 1. You do not need it if
            speeds were measured, but it is used instead of them if they were sampled more slowly than the commands.

    Raises:
        ValueError: if a quantity is missing, or the signals have no time in common.
    """
    checks.positive("dt", dt, "a positive number of seconds")
    if missing := missing_states(recording):
        raise ValueError(f"{recording.name}: contains no {' and no '.join(missing)}; {what_to_log(recording)}")
    signals = recording.signals
    motors = motors_of(recording, bool(len(polynomial)))
    used = [signals[name] for name in (*STATES, "body_velocity") if name in signals] + [motors]
    for signal in used:
        if len(signal) < 2:
            raise ValueError(f"{recording.name}: {signal.source} has fewer than two samples; log it at a higher rate")
    if apart := without_common_time(recording):
        raise ValueError(f"{recording.name}: {apart}")
    if motors.values.shape[1] > MOST_ROTORS:
        order = "name the motors of the rotors: motor_order=(0, 1, 2, 3)"
        raise ValueError(f"{recording.name}: {motors.source} has {motors.values.shape[1]} motors; {order}")
    first, last = max(signal.t[0] for signal in used), min(signal.t[-1] for signal in used)
    if last - first < dt:
        raise ValueError(f"{recording.name}: the signals overlap for less than {dt} s; log them at the same time")
    if (last - first) / dt > MAX_ROWS:
        raise ValueError(f"{recording.name}: {last - first:.4g} s have over {MAX_ROWS} samples of {dt} s; cut the log")
    t = np.minimum(first + dt * np.arange(int((last - first) / dt + 1e-6) + 1), last)
    q = interpolate_attitude(t, signals["attitude"].t, signals["attitude"].values)
    p, omega = (interpolate(t, signals[name].t, signals[name].values) for name in ("position", "rates"))
    if "velocity" in signals:
        v = interpolate(t, signals["velocity"].t, signals["velocity"].values)
    else:
        v = rotation_of(q).apply(interpolate(t, signals["body_velocity"].t, signals["body_velocity"].values))
    u = mean_of_held(t, motors.t, _speeds(recording, motors, polynomial))
    known = np.ones(len(t), bool)
    for signal in used:  # between two samples without a gap; the start of a gap counts as known
        inside = np.clip(np.searchsorted(signal.t, t, side="right") - 1, 0, len(signal) - 2)
        known &= ~(np.diff(signal.t) > GAP * max(signal.interval, dt))[inside] | (t == signal.t[inside])
    x = np.concatenate([p, q, v, omega], axis=1)
    return FlightLog(t[known] - first, x[known], u[known], recording.name)


def flight_at(recording: Recording, dt: float | None = None, polynomial: Sequence[float] = ()) -> FlightLog:
    """Return the flight at the times of complete CSV rows, or else at intervals of dt [s]; see `to_flight`."""
    rows = own_rows(recording)
    return to_flight(recording, dt or DT, polynomial) if rows is None else rows


def own_rows(recording: Recording) -> FlightLog | None:
    """Return the flight at the rows of a CSV file if most of them are complete, else None."""
    names = {"velocity" if "velocity" in recording.signals else "body_velocity", "rotor_speed"}
    names |= {"position", "attitude", "rates"}
    found = {name.removeprefix("body_"): each for name, each in recording.signals.items() if name in names}
    if recording.facts.get("format") != "CSV" or len(found) < len(names):
        return None
    t = reduce(np.intersect1d, (each.t for each in found.values()))
    if len(t) < max(2, WHOLE * max(map(len, found.values()))):
        return None
    p, v, q, omega, u = (found[name].values[np.isin(found[name].t, t)] for name in (*STATES, "rotor_speed"))
    v = rotation_of(q).apply(v) if "body_velocity" in names else v
    return FlightLog(t, np.concatenate([p, q, v, omega], axis=1), u, recording.name)


def missing_states(recording: Recording) -> list[str]:
    """List the quantities that a flight needs and the recording lacks, in part or entirely."""
    found = {name for name, signal in recording.signals.items() if len(signal.axes) >= 3}
    found |= {"velocity"} if "body_velocity" in found else set()
    return [name for name in STATES if name not in found] + ["motors"] * (not found & ROTOR_UNITS.keys())


def what_to_log(recording: Recording) -> str:
    """Advise what to log, or explain why a logged quantity was left out. For PX4, its topics file lists all topics."""
    kind, program = (recording.facts.get(name, "") for name in ("format", "program"))
    for note in (note for note in recording.notes if "is not valid" in note):
        return f"{note}; wait for the estimator"
    if kind != "PX4 ULog":
        return ADVICE.get(kind, "log it and fly again")
    found = re.match(r"PX4 (\d+)\.(\d+)\.", program)
    version = (int(found[1]), int(found[2])) if found else (99, 0)
    lines = [rf"{name} {ms}\n" for name, ms in PX4_TOPICS.items() if SINCE.get(name, (0, 0)) <= version]
    return f"on the SD card: printf '{''.join(lines)}' > etc/logging/logger_topics.txt"


def without_common_time(recording: Recording) -> str:
    """Describe two signals without a common time, for example from two clocks; "" if all have one."""
    signals = [signal for name, signal in recording.signals.items() if len(signal) and name != "voltage"]
    if not signals:
        return ""
    late, early = (limit(signals, key=lambda signal: signal.t[end]) for limit, end in ((max, 0), (min, -1)))
    if late.t[0] <= early.t[-1]:
        return ""
    times = " and ".join(f"{each.source} from {each.t[0]:.10g} to {each.t[-1]:.10g} s" for each in (early, late))
    return f"no time in common: {times}, from the first: do they have two clocks? log both with one (a time sync)"


def motors_of(recording: Recording, convertible: bool = True) -> Signal:
    """Choose rotor speeds, or commands if they can be converted and are faster."""
    speeds, commands = (recording.signals.get(name) for name in ("rotor_speed", "command"))
    faster = speeds is None or (convertible and commands is not None and commands.interval < 0.9 * speeds.interval)
    chosen = commands if faster else speeds
    if chosen is None:
        raise ValueError(f"{recording.name}: contains no motors; {what_to_log(recording)}")
    return chosen


def _speeds(recording: Recording, motors: Signal, polynomial: Sequence[float]) -> Float[np.ndarray, "n m"]:
    if motors is recording.signals.get("rotor_speed"):
        return motors.values
    if not len(polynomial):
        need = "polynomial=(c0, c1, …) maps them to rad/s = c0 + c1 command + …"
        raise ValueError(f"{recording.name}: has only motor commands from 0 to 1 ({motors.source}); {need}")
    # A motor at command 0 stands still, even if c0 is not 0.
    speeds = np.polynomial.polynomial.polyval(motors.values, polynomial)
    return np.where(motors.values > 0, np.maximum(speeds, 0.0), 0.0)
