"""When the vehicle of a recording is in the air: motors that turn do not yet carry it.

On the ground an accelerometer measures gravity whatever the thrust is. Near it the ground effect adds to the thrust.
"""

import numpy as np
from jaxtyping import Float

from hybrid_jax.flights.log import IDLE, RESTING, runs_of
from hybrid_jax.flights.recording import Recording, Signal

CLEAR = 0.2  # m above where the vehicle stood before its motors turned
MARGIN = 0.5  # s left out beside time with idle motors where the height is not known


def airborne(recording: Recording, told: str = "command") -> list[tuple[float, float]]:
    """Start and end [s] of each time in the air.

    Motors that idle for half a second end a flight. A flight that began with such a rest counts while the vehicle is
    `CLEAR` above the height at which it stood. If no height is measured, it counts once `MARGIN` has passed since the
    rest and the power has reached its median over the flight, which carries the vehicle.

    Args:
        told: the quantity that drives the rotors, "command" or "rotor_speed".
    """
    inputs = recording.signals[told]
    power = (np.asarray(inputs.values) ** 2).sum(axis=1)
    idle = np.zeros(len(power), bool)
    for part in runs_of(power < IDLE * np.quantile(power, 0.9)):
        idle[part] = inputs.t[part][-1] - inputs.t[part][0] >= RESTING
    height = recording.signals.get("position")
    found = []
    for run in runs_of(~idle):
        if height is not None and "z" in height.axes and run.start > 0:
            found += _above(inputs.t[run], height, float(inputs.t[run.start - 1]))
        else:
            found += _carried(inputs.t[run], power[run], run.start > 0, run.stop < len(power))
    return found


def _above(t: Float[np.ndarray, " n"], height: Signal, rest: float) -> list[tuple[float, float]]:
    """The times of t at which the vehicle is clear of where it stood at the end of its rest."""
    z = np.interp(np.append(t, rest), height.t, np.asarray(height.values)[:, height.axes.index("z")])
    return [(float(t[part][0]), float(t[part][-1])) for part in runs_of(z[:-1] > z[-1] + CLEAR)]


def _carried(t, power, rested: bool, rests: bool) -> list[tuple[float, float]]:
    begin = max(t[0] + MARGIN, t[np.argmax(power >= np.median(power))]) if rested else t[0]
    end = t[-1] - MARGIN if rests else t[-1]
    return [(float(begin), float(end))] if end > begin else []
