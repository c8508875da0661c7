"""What a log holds, before it is a flight: signals at their own rates, in the library's frames and units.

A reader turns a file of some format into a `Recording`. Checks judge it; `to_flight` and the identification from
commands and measurements take from it what they need.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

GAP = 5.0  # intervals longer than this many times the median are gaps

# Quantities by name: their axes and unit. Bodies are forward-left-up, the world is z up.
AXES: dict[str, tuple[tuple[str, ...], str]] = {
    "position": (("x", "y", "z"), "m"),
    "velocity": (("x", "y", "z"), "m/s"),  # in the world
    "body_velocity": (("x", "y", "z"), "m/s"),
    "attitude": (("w", "x", "y", "z"), "1"),  # unit quaternion, body to world
    "rates": (("x", "y", "z"), "rad/s"),  # of the body
    "specific_force": (("x", "y", "z"), "m/s²"),  # of the body: what an accelerometer measures
    "voltage": (("battery",), "V"),
}
ROTOR_UNITS = {"rotor_speed": "rad/s", "command": "1"}  # one axis for each rotor; commands are shares of the largest
QUANTITIES = (*AXES, *ROTOR_UNITS)


@dataclass(frozen=True)
class Signal:
    """n samples of one quantity.

    Attributes:
        t: time of each sample [s], strictly increasing, from the start of the recording.
        values: one column for each of `axes`, in SI units.
        axes: which axes were measured, in the order of `AXES`; of rotors "0", "1", …
        source: topic, group or columns that it came from, for messages.

    Raises:
        ValueError: inconsistent shapes, values that are not finite, or times that do not increase: source and time.
    """

    t: Float[np.ndarray, " n"] = field(repr=False)
    values: Float[np.ndarray, "n k"] = field(repr=False)
    axes: tuple[str, ...]
    source: str

    def __post_init__(self):
        t, values = np.array(self.t, float), np.array(self.values, float)
        if t.ndim != 1 or values.shape != (len(t), len(self.axes)):
            shapes = f"got {t.shape} and {values.shape}"
            raise ValueError(f"{self.source}: t and values must be (n,) and (n, {len(self.axes)}), {shapes}")
        for row in np.flatnonzero(t[1:] <= t[:-1])[:1] + 1:
            raise ValueError(f"{self.source}: time {t[row]:.6g} s does not come after {t[row - 1]:.6g} s")
        for row, column in np.argwhere(~np.isfinite(values))[:1].tolist():
            axis = self.axes[column]
            raise ValueError(f"{self.source}: {axis} is {values[row, column]} at {t[row]:.6g} s, must be finite")
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "values", values)

    def __len__(self) -> int:
        return len(self.t)

    @property
    def interval(self) -> float:
        """The median time between samples [s]; infinite for fewer than two."""
        return float(np.median(np.diff(self.t))) if len(self) > 1 else np.inf

    def gaps(self) -> list[tuple[float, float]]:
        """Start and end [s] of each time without samples."""
        missing = np.flatnonzero(np.diff(self.t) > GAP * self.interval)
        return [(float(self.t[i]), float(self.t[i + 1])) for i in missing]


@dataclass(frozen=True)
class Recording:
    """The signals of one log.

    Attributes:
        name: of the log in messages, usually its file.
        signals: by names of `QUANTITIES`; what was not recorded is absent.
        notes: what the reader left out or had to assume, a sentence each.
        facts: what the log says of its vehicle and program, such as {"airframe": "4001"}, for reports and checks.

    Raises:
        ValueError: an unknown quantity, or axes that it does not have.
    """

    name: str
    signals: Mapping[str, Signal]
    notes: tuple[str, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self):
        for quantity, signal in self.signals.items():
            if quantity not in QUANTITIES:
                raise ValueError(f"{self.name}: {quantity!r} must be one of {', '.join(QUANTITIES)}")
            known = AXES[quantity][0] if quantity in AXES else tuple(map(str, range(len(signal.axes))))
            if not signal.axes or signal.axes != tuple(axis for axis in known if axis in signal.axes):
                raise ValueError(f"{self.name}: {quantity}: axes must be of {', '.join(known)}, got {signal.axes}")

    @property
    def rotors(self) -> int:
        """How many rotors were commanded or measured; 0 if none."""
        found = [len(self.signals[name].axes) for name in ROTOR_UNITS if name in self.signals]
        return max(found, default=0)

    @property
    def duration(self) -> float:
        """From the first to the last sample of the signal that lasts longest [s]."""
        return max((float(signal.t[-1] - signal.t[0]) for signal in self.signals.values() if len(signal)), default=0.0)
