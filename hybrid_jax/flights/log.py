"""A recorded flight in the library's frames and units, checked when it is created."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from hybrid_jax.state import INPUT_NAMES, INPUT_SIZE, QUATERNION, STATE_NAMES, STATE_SIZE

NORM_TOLERANCE = 0.02  # allows |q| of two printed digits; wrong columns are hardly ever within it
COLUMNS = ("t", *STATE_NAMES, *INPUT_NAMES)


@dataclass(frozen=True)
class FlightLog:
    """n samples of one flight. Quaternions are normalised and their signs made continuous, the first with w ≥ 0.

    Attributes:
        t: time of each sample [s], strictly increasing.
        x: state at that time, as in `hybrid_jax.state`: z up, forward-left-up, SI.
        u: rotor speeds held from this sample to the next [rad/s].
        name: of the flight in messages and reports, usually its file.

    Raises:
        ValueError: inconsistent shapes, or the first impossible sample and field, in one line.
    """

    t: Float[np.ndarray, " n"] = field(repr=False)
    x: Float[np.ndarray, "n 13"] = field(repr=False)
    u: Float[np.ndarray, "n 4"] = field(repr=False)
    name: str = "flight"

    def __post_init__(self):
        t, x, u = (np.array(array, float) for array in (self.t, self.x, self.u))
        if t.ndim != 1 or x.shape != (len(t), STATE_SIZE) or u.shape != (len(t), INPUT_SIZE):
            raise ValueError(f"{self.name}: t, x, u must be (n,), (n, 13), (n, 4), got {t.shape}, {x.shape}, {u.shape}")
        require_possible(t, x, u, self.name)
        x[:, QUATERNION] = _canonical(x[:, QUATERNION])
        for name, array in (("t", t), ("x", x), ("u", u)):
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows) -> "FlightLog":
        """The samples selected by a slice, a mask or increasing indices."""
        return FlightLog(self.t[rows], self.x[rows], self.u[rows], self.name)

    @property
    def dt(self) -> float:
        """The median interval between samples [s], rounded to nanoseconds so that logs of one rate agree.

        Raises:
            ValueError: fewer than two samples.
        """
        if len(self) < 2:
            raise ValueError(f"{self.name}: {len(self)} samples have no interval")
        return round(float(np.median(np.diff(self.t))), 9)


def require_possible(
    t: Float[np.ndarray, " n"],
    x: Float[np.ndarray, "n 13"],
    u: Float[np.ndarray, "n 4"],
    origin,
    unit="sample",
    first=0,
) -> None:
    """Refuse numbers that are impossible in a flight.

    Args:
        unit, first: name of a sample in messages and the number of the first, such as ("row", 2).

    Raises:
        ValueError: origin, sample, field and what to do, in one line.
    """
    if len(t) == 0:
        raise ValueError(f"{origin}: has no samples; record or export the flight again")
    for sample, name, complaint in _problems(t, x, u):
        raise ValueError(f"{origin}: {unit} {sample + first}, field {name}: {complaint}")


def _problems(t, x, u) -> Iterator[tuple[int, str, str]]:
    """Impossible values: index of the sample, field and what to do."""
    for names, block in ((("t",), t[:, None]), (STATE_NAMES, x), (INPUT_NAMES, u)):
        bad = ~np.isfinite(block)
        if bad.any():
            row, column = np.argwhere(bad)[0].tolist()
            yield row, names[column], f"is {block[row, column]}; cut the sample out (it becomes a gap) or repair it"
    # Compare, as a difference of finite times may overflow.
    for row in np.flatnonzero(t[1:] <= t[:-1])[:1] + 1:
        times = f"{t[row]:.6g} {'repeats' if t[row] == t[row - 1] else 'goes back from'} {t[row - 1]:.6g}"
        yield row, "t", f"time {times}; sort the samples, drop doubles, split restarted clocks"
    with np.errstate(over="ignore"):  # an infinite norm is refused too
        norm = np.linalg.norm(x[:, QUATERNION], axis=1)
    for row in np.flatnonzero(np.abs(norm - 1) > NORM_TOLERANCE)[:1]:
        advice = "cut out samples without an attitude" if norm[row] == 0 else "are these the four quaternion columns?"
        yield row, "qw qx qy qz", f"norm is {norm[row]:.4g}, not 1; {advice}"
    for row, column in np.argwhere(u < 0)[:1].tolist():
        yield row, INPUT_NAMES[column], f"rotor speed {u[row, column]:.6g} is negative; give its magnitude in rad/s"


def _canonical(q: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Unit quaternions without jumps from q to −q."""
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    flips = np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    start = -1.0 if q[0, 0] < 0 else 1.0
    return q * (start * np.cumprod([1.0, *flips]))[:, None]
