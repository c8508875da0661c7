"""Read PX4 ULog files with pyulog (extra `logs`).

PX4 states attitude as body FRD → world NED and vectors in these frames (msg/versioned/VehicleAttitude.msg,
msg/versioned/VehicleLocalPosition.msg). Each topic has its own time stamps; all are resampled to one grid.
"""

import contextlib
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hybrid_jax.flights.attitude import Frames, interpolate, interpolate_attitude, mean_of_held, to_library
from hybrid_jax.flights.flight_csv import MAX_ROWS
from hybrid_jax.flights.log import FlightLog, wrong_norms

FRAMES = Frames(world="NED", body="FRD", velocity="world")
STATES = {
    "vehicle_local_position": ("x", "y", "z", "vx", "vy", "vz"),
    "vehicle_attitude": ("q[0]", "q[1]", "q[2]", "q[3]"),
    "vehicle_angular_velocity": ("xyz[0]", "xyz[1]", "xyz[2]"),
}
RPM = "esc_status"
# Of motors; the first topic that the log has is used.
FIELDS = {RPM: "esc[{}].esc_rpm", "actuator_motors": "control[{}]", "actuator_outputs": "output[{}]"}
LOST = 5  # an interval above this multiple of a topic's median, or of dt, is a gap and is not interpolated across


def read_ulog(
    path: str | Path, *, dt: float = 0.01, motor_order: Sequence[int] = (0, 1, 2, 3), polynomial: Sequence[float] = ()
) -> FlightLog:
    """Read one flight at intervals of dt [s]; where a topic has a gap, the log has one too.

    Position, velocity and rates are interpolated linearly, attitude spherically; rotor speeds are means of held values.

    Args:
        motor_order: which motor (0 is PX4's motor 1) each of the vehicle's rotors is.
        polynomial: rotor speed [rad/s] = Σ polynomial[i] commandⁱ; not needed where the log has ESC rpm.

    Raises:
        ValueError: file, topic and what to do, in one line; or pyulog is not installed.
    """
    if not dt > 0:
        raise ValueError(f"dt must be a positive number of seconds, got {dt!r}")
    data = _load(path)
    (tp, local), (tq, q), (tw, omega) = (_samples(data, path, topic, fields) for topic, fields in STATES.items())
    tu, u = _motors(data, path, motor_order, polynomial)
    if wrong_norms(q):
        advice = "cut the log where there is no attitude"
        raise ValueError(f"{path}: topic vehicle_attitude, field q: norm is not 1; {advice}")
    times = (tp, tq, tw, tu)
    first, last = max(at[0] for at in times), min(at[-1] for at in times)
    if last - first < dt:
        raise ValueError(f"{path}: the topics share less than one interval of {dt} s; log them at the same time")
    count = int((last - first) / dt + 1e-6)
    if count > MAX_ROWS:
        raise ValueError(f"{path}: {last - first:.4g} s at dt = {dt} are more than {MAX_ROWS} samples; cut the log")
    t = np.minimum(first + dt * np.arange(count + 1), last)
    local = interpolate(t, tp, local)
    x = to_library(local[:, :3], interpolate_attitude(t, tq, q), local[:, 3:], interpolate(t, tw, omega), FRAMES)
    speeds = mean_of_held(t, tu, u)
    known = np.logical_and.reduce([_is_known(t, at, dt) for at in times])
    return FlightLog(t[known] - first, x[known], speeds[known], str(path))


def _load(path: str | Path):
    try:
        import pyulog
    except ImportError as error:
        raise ValueError(f"{path}: reading ULog needs pyulog: pip install 'hybrid_jax[logs]'") from error
    try:
        # pyulog reports damage on standard output only.
        with contextlib.redirect_stdout(io.StringIO()):
            log = pyulog.ULog(str(path), [*STATES, *FIELDS])
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except Exception as error:  # pyulog raises any exception for a damaged file
        raise ValueError(f"{path}: is not a ULog or is damaged; download it again ({type(error).__name__})") from error
    if log.file_corruption:
        raise ValueError(f"{path}: is damaged (pyulog found corrupt messages); download it again")
    return {dataset.name: dataset.data for dataset in reversed(log.data_list)}  # the first instance of each topic


def _samples(data, path, topic: str, fields: tuple[str, ...], clock: str = "timestamp_sample"):
    """Time [s] and fields of a topic, sorted by time and without duplicates."""
    if topic not in data:
        raise ValueError(f"{path}: has no topic {topic}; add it to the logged topics of the vehicle")
    table = data[topic]
    for field in fields:
        if field not in table:
            raise ValueError(f"{path}: topic {topic} has no field {field}; is this a log of PX4 1.12 or later?")
    # The time of the measurement where it is recorded, else that of the message.
    use_clock = clock in table and table[clock].min(initial=1) > 0
    t = table[clock if use_clock else "timestamp"].astype(np.int64) * 1e-6
    with np.errstate(invalid="ignore"):  # damaged numbers are refused below
        values = np.stack([table[field] for field in fields], axis=1).astype(float)
    for row, column in () if topic in FIELDS else np.argwhere(~np.isfinite(values))[:1].tolist():
        where = f"topic {topic}, sample {row}, field {fields[column]}"
        raise ValueError(f"{path}: {where}: is not finite; cut the log there")
    t, kept = np.unique(t, return_index=True)
    if len(t) < 2:
        raise ValueError(f"{path}: topic {topic} has fewer than two samples; log it at a higher rate")
    return t, values[kept]


def _motors(data, path, order, polynomial) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4"]]:
    """Time and rotor speeds [rad/s]: ESC rpm where there are any, else commands through the polynomial."""
    if sorted(order) != [0, 1, 2, 3]:
        raise ValueError(f"motor_order must hold 0, 1, 2, 3 in some order, got {order}")
    for topic, field in FIELDS.items():
        if topic not in data:
            continue
        t, values = _samples(data, path, topic, tuple(field.format(motor) for motor in order), "timestamp")
        if topic == RPM and np.abs(values).max() > 0:
            return t, np.abs(values) * np.pi / 30
        if topic == RPM:
            continue  # ESCs without telemetry report zero
        if not polynomial:
            raise ValueError(f"{path}: has only motor commands ({topic}); give the polynomial that maps them to rad/s")
        on = np.isfinite(values)  # PX4 writes NaN for a motor that is disarmed
        return t, np.where(on, np.polynomial.polynomial.polyval(np.where(on, values, 0.0), polynomial), 0.0)
    raise ValueError(f"{path}: has no motors (none of {', '.join(FIELDS)}); log one of these topics and fly again")


def _is_known(t: Float[np.ndarray, " m"], at: Float[np.ndarray, " n"], dt: float):
    """Whether t lies between two samples without a gap; the start of a gap counts as known."""
    intervals = np.diff(at)
    lost = intervals > LOST * max(float(np.median(intervals)), dt)
    inside = np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(intervals) - 1)
    return ~lost[inside] | (t == at[inside])
