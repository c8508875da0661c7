"""Check the raw signals of a recording: are they complete, of the expected vehicle, and fast enough?"""

import numpy as np

from hybrid_jax.flights.checks.consistency import CLOCK, LONGEST_INTERVAL, UNKNOWN, Check, judged
from hybrid_jax.flights.conversion import missing_states, motors_of, what_to_log, without_common_time
from hybrid_jax.flights.recording import ROTOR_UNITS, Recording, Signal
from hybrid_jax.vehicle import MOST_ROTORS, Vehicle

SLOWER = 1.5  # times the requested interval
REST_SHARE = 0.05  # of the largest command or speed, below which a motor does not carry
REST_SPEED = 20.0  # rad/s, if the largest is unknown
SLOW_ROTOR = 100.0  # rad/s; the rotors of every multirotor turn faster than 955 rpm in flight
STILL = 5.0  # rad/s, below which a rotor stands
MOVED = 0.5  # m of height that only flight explains
BEYOND = 0.02  # share by which a motor may exceed the largest
MOSTLY = 0.5  # share of samples beyond a limit above which their unit is wrong
JUMP = 0.5  # share of the whole time that one gap may last
ROTORS = "number of motors"
USED = ("position", "velocity", "body_velocity", "attitude", "rates")


def check_recording(recording: Recording, vehicle: Vehicle | None = None, dt: float | None = None) -> list[Check]:
    """Check the signals of a recording. You should do this before they are interpolated.

    Args:
        recording: the log as it was read.
        vehicle: the expected vehicle. You should give it to check the number of rotors and the largest speed.
        dt: the interval that you want between samples [s]. You should give it to check the rates of signals.
    """
    damage, missing = recording.facts.get("damage", ""), missing_states(recording)
    motors = motors_of(recording) if recording.signals.keys() & ROTOR_UNITS.keys() else None
    remedy = f'{damage}; copy it again, or use what is whole: failed="warn"' if damage else ""
    lacks = f"no {', no '.join(missing)}: {what_to_log(recording)}" if missing else ""
    return [
        judged("whole file", bool(damage), "", 0.0, remedy),
        _airframe(recording),
        _flown(recording, motors, vehicle),
        judged("quantities", len(missing), "missing", 0.0, lacks),
        _rotors(recording, vehicle),
        _rates(recording, motors, dt or np.inf),
        _clock(recording),
        _limits(recording, vehicle),
    ]


def _airframe(recording: Recording) -> Check:
    kind, number = recording.facts.get("vehicle", "unknown"), recording.facts.get("airframe")
    if kind in ("unknown", "generic"):
        return Check("airframe", np.nan, "", 0.0, UNKNOWN, "the log does not name the type of vehicle")
    advice = f"{kind}{f' (SYS_AUTOSTART {number})' if number else ''}, not a multirotor: leave the file out"
    return judged("airframe", 0.0, "", 0.0, "" if kind.startswith("multirotor") else advice)


def _rotors(recording: Recording, vehicle: Vehicle | None) -> Check:
    found, kind = recording.rotors, recording.facts.get("vehicle", "")
    stated = [int(word) for word in kind.split() if word.isdigit()]
    expected = vehicle.rotors if vehicle is not None else stated[0] if stated else found
    if not found:
        return Check(ROTORS, 0.0, "motors", expected, UNKNOWN, "no motors")
    remedy = "log all motors"
    if found > expected or found > MOST_ROTORS:
        signals = [recording.signals[name] for name in ROTOR_UNITS if name in recording.signals]
        moving = tuple(i for i in range(found) if any(np.ptp(signal.values[:, i]) > 0 for signal in signals))
        named = moving if vehicle is None and not stated else moving[:expected]
        remedy = f"name the motors that change: motor_order={named}"
    who = "the airframe" if vehicle is None else "the vehicle file"
    advice = f"{found} motors are logged, {who} has {expected}: {remedy}, or correct the vehicle file"
    fits = found == expected and found <= MOST_ROTORS
    return judged(ROTORS, found, "motors", expected, "" if fits else advice)


def _rates(recording: Recording, motors: Signal | None, dt: float) -> Check:
    intervals = {name: recording.signals[name].interval for name in USED if name in recording.signals}
    intervals |= {} if motors is None else {"motors": motors.interval}
    slow = {name: interval for name, interval in intervals.items() if interval > SLOWER * dt * (1 + 1e-6)}
    worst = max(intervals.values(), default=np.nan)
    listed = ", ".join(f"{name} {1 / each:.3g} Hz" for name, each in slow.items())
    coarser = f"dt={float(f'{max(slow.values(), default=0.0):.2g}'):g}"
    faster = "log faster" if recording.facts.get("format", "") == "CSV" else what_to_log(recording)
    advice = f"slower than {1 / dt:.3g} Hz: {listed}; {faster}; or take {coarser}"
    if slow and min(intervals.values()) > LONGEST_INTERVAL:
        advice = f"all signals are over {LONGEST_INTERVAL} s apart: {CLOCK}"
    return judged("slowest signal", worst, "s", SLOWER * dt, advice if slow else "")


def _clock(recording: Recording) -> Check:
    if apart := without_common_time(recording):
        return judged("longest gap", recording.duration, "s", JUMP * recording.duration, apart)
    gaps = [(end - start, start, each.source) for each in recording.signals.values() for start, end in each.gaps()]
    length, start, source = max(gaps, default=(0.0, 0.0, ""))
    advice = f"{source} stops at {start:.4g} s for {length:.4g} s, most of the log: split the file there"
    most = JUMP * recording.duration
    return judged("longest gap", length, "s", most, advice if length > most else "")


def _limits(recording: Recording, vehicle: Vehicle | None) -> Check:
    """Check that commands are in 0 … 1 and speeds do not exceed the vehicle's maximum."""
    fastest = np.inf if vehicle is None else vehicle.max_rotor_speed
    for name, most in (("command", 1.0), ("rotor_speed", fastest)):
        if name not in recording.signals:
            continue
        signal = recording.signals[name]
        beyond = (signal.values > (1 + BEYOND) * most) | (signal.values < -BEYOND * min(most, 1.0))
        share = float(beyond.any(axis=1).mean())
        for row, column in np.argwhere(beyond)[:1].tolist():
            value = signal.values[row, column]
            wrap = name == "command" and -0.51 < signal.values.min() < 0 and signal.values.max() < 0.51
            remedy = "a 16-bit number wrapped: log it without sign" if wrap else "cut these samples out"
            remedy += " or raise max_rotor_speed of the vehicle file" if name == "rotor_speed" and value > 0 else ""
            if share > MOSTLY and not wrap:
                remedy = "most are: are they in another unit, for example PWM in µs? declare it"
            where = f"{name} of motor {column} is {value:.4g} at {signal.t[row]:.4g} s, must be from 0 to {most:.4g}"
            return judged("motors within limits", share, "share of samples", 0.0, f"{where}: {remedy}")
    return judged("motors within limits", 0.0, "share of samples", 0.0, "")


def _flown(recording: Recording, motors: Signal | None, vehicle: Vehicle | None) -> Check:
    name = "motors turn"
    if motors is None or not len(motors):
        return Check(name, np.nan, "", 0.0, UNKNOWN, "no motors")
    speeds = motors is recording.signals.get("rotor_speed")
    most = vehicle.max_rotor_speed if vehicle is not None else REST_SPEED / REST_SHARE
    limit = REST_SHARE * (most if speeds else 1.0)
    # Of the fastest three, because some channels may not belong to a motor.
    value = float(np.sort(motors.values, axis=1)[:, -3:].mean(axis=1).max())
    position = recording.signals.get("position")
    climbed = float(np.ptp(position.values[:, -1])) if position is not None and position.axes[-1] == "z" else 0.0
    advice = ""
    if speeds and STILL < value < SLOW_ROTOR:
        finding = f"rotor speeds up to {value:.3g} rad/s ({value * 30 / np.pi:.4g} rpm) are too slow for flight"
        advice = f"{finding}: are they percent of a command, or rad/s or rev/s, read as rpm? correct their unit"
    elif value < limit and climbed > MOVED:
        finding = f"the motors of {motors.source} rest, and yet the height changes by {climbed:.2g} m"
        advice = f"{finding}: the vehicle's own are in another topic, instance or column: name or log those"
    elif value < limit:
        advice = "the motors rest throughout, so nothing flew: leave the file out"
    return judged(name, value, "rad/s" if speeds else "of the largest", limit, advice)
