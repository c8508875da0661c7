"""Check logs before a vehicle is identified from them, as far as their signals allow."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hybrid_jax.dynamics.actuators import Actuated
from hybrid_jax.flights.attitude import interpolate, interpolate_attitude, rotation_of
from hybrid_jax.flights.checks.airborne import airborne, within
from hybrid_jax.flights.checks.consistency import ORDER, RATES, RATIO, SPIN, THRUST, Check, check_log
from hybrid_jax.flights.conversion import DT, STATES, to_flight
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.recording import AXES, Recording, Signal
from hybrid_jax.identification.slow_commands import SLOW

MOTORS = "rotor_speed"
DRAGGED = 0.6  # correlation of forces with the velocity above which they are drag
GUESSED = 10.0  # factor by which a thrust that is learned may be wrong; wrong units differ by more
OF_THRUST = {"curve", "mass", "k", "k_rotors"}
# The signals that checks need, the longest sample interval [s] at which they are useful, and their names.
# Identification skips gaps and time on the ground, and learns or ignores the lag.
COMPARED = (
    (("position", "velocity"), 0.05, ("dp/dt against v",)),
    (("attitude", "rates"), 0.05, (RATES,)),
    (("attitude", "velocity", MOTORS), 0.11, (THRUST, RATIO)),
    (("rates", MOTORS), SLOW, ("columns", ORDER, SPIN)),
    ((MOTORS,), np.inf, ("interval between samples",)),
)


def compared(recording: Recording, field: Any, learn: Sequence[str]) -> list[Check]:
    """Run all checks of a flight that the signals allow, each at the rate of its signals."""
    body: Any = field.body if isinstance(field, Actuated) else field
    signals = _signals(recording, field)
    runs, found = {}, []
    for needs, longest, names in COMPARED:
        dt = round(max(DT, *(signals[name].interval if name in signals else np.inf for name in needs)), 6)
        if dt > longest or not np.isfinite(dt):
            continue
        if dt not in runs:
            runs[dt] = check_log(_flight(recording, signals, dt), body.vehicle)
        found += [check for check in runs[dt] if check.name in names]
    guessed = not OF_THRUST.isdisjoint(learn)
    return [each for each in found if not (guessed and each.name == RATIO and 1 / GUESSED < each.value < GUESSED)]


def _flight(recording: Recording, signals: dict[str, Signal], dt: float) -> FlightLog:
    """Return the airborne flight, or all of it if it is never airborne.

    States that are missing, or sampled more slowly than dt, are replaced by rest at the origin.
    """
    motors, kept = signals[MOTORS], {MOTORS: signals[MOTORS]}
    for name in STATES:
        if name in signals and signals[name].interval <= 1.5 * dt:
            in_body = signals[name] is recording.signals.get("body_velocity")
            kept["body_velocity" if in_body else name] = signals[name]
        else:
            rest = [1.0, 0, 0, 0] if name == "attitude" else [0.0] * 3
            kept[name] = Signal(motors.t[[0, -1]], np.tile(rest, (2, 1)), AXES[name][0], "nothing")
    log, first = to_flight(replace(recording, signals=kept), dt), max(signal.t[0] for signal in kept.values())
    spans = airborne(replace(recording, signals={**recording.signals, MOTORS: motors}), MOTORS)
    flying = within(log.t + first, spans)
    return log[flying] if np.count_nonzero(flying) > 1 else log


def _signals(recording: Recording, field: Any) -> dict[str, Signal]:
    """Return the signals of a flight, with rotor speeds that follow commands without lag."""
    found = {name: signal for name, signal in recording.signals.items() if len(signal.axes) >= 3 and len(signal) > 1}
    attitude, body = found.get("attitude"), found.pop("body_velocity", None)
    if body and attitude and "velocity" not in found and attitude.interval < 1.5 * body.interval:
        found["velocity"] = body  # `to_flight` turns it
    motors = recording.signals["command" if isinstance(field, Actuated) else MOTORS]
    speeds = motors.values
    if isinstance(field, Actuated):
        speeds = np.asarray(field.steady_speeds(jnp.asarray(inputs_of(recording, field).T)).T)
    return found | {MOTORS: replace(motors, values=np.maximum(speeds, 0.0))}


def inputs_of(recording: Recording, field: Actuated) -> Float[np.ndarray, "n m"]:
    """Return the commands and, if the field reads it, the voltage, by default the nominal one."""
    inputs, voltage = recording.signals["command"], recording.signals.get("voltage")
    if not field.reads_voltage:
        return np.asarray(inputs.values)
    known = field.actuator.nominal_voltage
    volts = known if voltage is None else np.interp(inputs.t, voltage.t, np.asarray(voltage.values)[:, 0])
    return np.column_stack([inputs.values, np.broadcast_to(volts, len(inputs))])


def unlearned_drag(logs: Sequence[Recording]) -> str:
    """Return a warning if forces across the thrust depend on the velocity, else an empty string."""
    if not (both := [pair for log in logs if (pair := _across(log)) is not None]):
        return ""
    force, velocity = (np.concatenate(each).ravel() for each in zip(*both, strict=True))
    share = force @ velocity / max(np.linalg.norm(force) * np.linalg.norm(velocity), 1e-12)
    if share > -DRAGGED:
        return ""
    slope = force @ velocity / (velocity @ velocity)
    found = f"specific force across the thrust is {slope:.2g} v (correlation {share:.2f})"
    return f"{found}: drag, which is not learned, so lag and inertia absorb it: learn drag as well"


def _across(log: Recording) -> tuple[np.ndarray, np.ndarray] | None:
    """Return specific force and velocity along body x and y, if both were measured."""
    force, q, v, own = map(log.signals.get, ("specific_force", "attitude", "velocity", "body_velocity"))
    if force is None or force.axes != ("x", "y", "z"):
        return None
    if own is not None:
        return force.values[:, :2], interpolate(force.t, own.t, own.values)[:, :2]
    if v is None or q is None:
        return None
    inside = (force.t >= q.t[0]) & (force.t <= q.t[-1])
    t = force.t[inside]
    turned = rotation_of(interpolate_attitude(t, q.t, q.values)).inv().apply(interpolate(t, v.t, v.values))
    return force.values[inside, :2], turned[:, :2]
