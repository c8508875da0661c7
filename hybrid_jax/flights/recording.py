"""A log as recorded: signals at their own rates, in the library's frames and units."""

from dataclasses import dataclass

from hybrid_jax.records import GAP, Record, Signal

__all__ = ["AXES", "GAP", "QUANTITIES", "ROTOR_UNITS", "Recording", "Signal"]

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


def unit_of(quantity: str) -> str:
    return ROTOR_UNITS[quantity] if quantity in ROTOR_UNITS else AXES[quantity][1]


def axes_of(quantity: str, count: int) -> tuple[str, ...]:
    """Name the axes of `count` columns of a quantity. If it has fewer columns than axes, they are the last axes."""
    return AXES[quantity][0][-count:] if quantity in AXES else tuple(map(str, range(count)))


@dataclass(frozen=True)
class Recording(Record):
    """The signals of one log, named as in `QUANTITIES`; ValueError for others. For the attributes see `Record`."""

    def __post_init__(self):
        for quantity, signal in self.signals.items():
            if quantity not in QUANTITIES:
                raise ValueError(f"{self.name}: {quantity!r} must be one of {', '.join(QUANTITIES)}")
            known = AXES[quantity][0] if quantity in AXES else tuple(map(str, range(len(signal.axes))))
            if not signal.axes or signal.axes != tuple(axis for axis in known if axis in signal.axes):
                raise ValueError(f"{self.name}: {quantity}: axes must be of {', '.join(known)}, got {signal.axes}")

    @property
    def rotors(self) -> int:
        """The number of rotors that were commanded or measured."""
        found = [len(self.signals[name].axes) for name in ROTOR_UNITS if name in self.signals]
        return max(found, default=0)
