"""A recorded flight in the library's frames and units, validated when it is created, and its segments without gaps."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from hybrid_jax.vehicle import FEWEST_ROTORS, INPUT_NAMES, MOST_ROTORS, QUATERNION, STATE_NAMES, STATE_SIZE, input_names

NORM_TOLERANCE = 0.02  # allows quaternions of two printed digits, but hardly ever wrong columns
COLUMNS = ("t", *STATE_NAMES, *INPUT_NAMES)  # of a quadrotor
LARGEST = 1e9  # largest plausible state or motor value, in SI units
GAP = 1.5  # intervals longer than this many times the median are gaps
JITTER = 0.1  # relative deviation from the median interval that still counts as evenly spaced


@dataclass(frozen=True)
class FlightLog:
    """The n samples of one flight. Quaternions are normalised, and continuous in sign, with w ≥ 0 in the first.

    Attributes:
        t: time of each sample [s], which should increase strictly.
        x: state (n, 13) at that time, as in `hybrid_jax.vehicle`: z up, forward-left-up, SI units.
        u: rotor speeds (n, rotors) [rad/s], constant from this sample to the next.
        name: name of the flight in messages and reports, usually its file.

    Raises:
        ValueError: if shapes do not agree, or a sample is impossible.
    """

    t: Float[np.ndarray, " n"] = field(repr=False)
    x: Float[np.ndarray, "n 13"] = field(repr=False)
    u: Float[np.ndarray, "n rotors"] = field(repr=False)
    name: str = "flight"

    def __post_init__(self):
        t, x, u = (np.array(array, float) for array in (self.t, self.x, self.u))
        rotors = u.shape[-1] if u.ndim == 2 and FEWEST_ROTORS <= u.shape[-1] <= MOST_ROTORS else len(INPUT_NAMES)
        if t.ndim != 1 or x.shape != (len(t), STATE_SIZE) or u.shape != (len(t), rotors):
            shapes = f"(n,), (n, 13), (n, {FEWEST_ROTORS} … {MOST_ROTORS})"
            raise ValueError(f"{self.name}: t, x, u must be {shapes}, got {t.shape}, {x.shape}, {u.shape}")
        if len(t) == 0:
            raise ValueError(f"{self.name}: has no samples; record or export the flight again")
        for sample, name, complaint in _problems(t, x, u):
            raise ValueError(f"{self.name}: sample {sample}, field {name}: {complaint}")
        x[:, QUATERNION] = _canonical(x[:, QUATERNION])
        for name, array in (("t", t), ("x", x), ("u", u)):
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows) -> "FlightLog":
        """Select samples by a slice, a mask or increasing indices."""
        return FlightLog(self.t[rows], self.x[rows], self.u[rows], self.name)

    @property
    def dt(self) -> float:
        """The median interval between samples [s], to nanoseconds; ValueError if there are fewer than two."""
        if len(self) < 2:
            raise ValueError(f"{self.name}: has {len(self)} samples; at least two are needed for an interval")
        return round(float(np.median(np.diff(self.t))), 9)


def _problems(t, x, u) -> Iterator[tuple[int, str, str]]:
    """Iterate over impossible values: index of the sample, field and what to do."""
    rotors = input_names(u.shape[1])
    for names, block in ((("t",), t[:, None]), (STATE_NAMES, x), (rotors, u)):
        sound = np.isfinite(block) if names == ("t",) else np.abs(block) < LARGEST
        for row, column in np.argwhere(~sound)[:1].tolist():
            yield row, names[column], f"is {block[row, column]:.6g}; cut the sample out (it becomes a gap) or repair it"
    # Times are compared, because the difference of finite times may overflow.
    for row in np.flatnonzero(t[1:] <= t[:-1])[:1] + 1:
        times = f"{t[row]:.6g} {'repeats' if t[row] == t[row - 1] else 'goes back from'} {t[row - 1]:.6g}"
        yield row, "t", f"time {times}; sort the samples, drop doubles, split restarted clocks"
    for row in np.flatnonzero(unlike_one(x[:, QUATERNION]))[:1].tolist():
        norm = np.linalg.norm(x[row, QUATERNION])
        advice = "cut out samples without an attitude" if norm == 0 else "are these the four quaternion columns?"
        yield row, "qw qx qy qz", f"norm is {norm:.4g}, not 1; {advice}"
    for row, column in np.argwhere(u < 0)[:1].tolist():
        yield row, rotors[column], f"rotor speed {u[row, column]:.6g} is negative; give its magnitude in rad/s"


def unlike_one(q: Float[np.ndarray, "n 4"]) -> Bool[np.ndarray, " n"]:
    """Whether the norm of each quaternion differs from 1."""
    with np.errstate(over="ignore", invalid="ignore"):  # an infinite norm is rejected too
        return ~(np.abs(np.linalg.norm(q, axis=1) - 1) <= NORM_TOLERANCE)


def _canonical(q: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Normalise quaternions and remove jumps from q to −q."""
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    flips = np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    start = -1.0 if q[0, 0] < 0 else 1.0
    return q * (start * np.cumprod([1.0, *flips]))[:, None]


def gaps(log: FlightLog) -> Bool[np.ndarray, " n-1"]:
    """Whether samples are missing in each interval."""
    return np.diff(log.t) > GAP * log.dt if len(log) > 1 else np.zeros(0, bool)


def repeats(log: FlightLog) -> Bool[np.ndarray, " n"]:
    """Whether a state equals its predecessor in every digit, which noise makes impossible for fresh samples."""
    return np.concatenate([[False], (np.diff(log.x, axis=0) == 0).all(axis=1)])


def sound_intervals(log: FlightLog) -> Bool[np.ndarray, " n-1"]:
    """Whether each interval is without a gap and has fresh samples at both ends."""
    stale = repeats(log)
    return ~(gaps(log) | stale[:-1] | stale[1:])


def runs_of(mask: Bool[np.ndarray, " n"], extra: int = 0) -> list[slice]:
    """Find the maximal runs of true entries, each extended by `extra` at its end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]]))).tolist()
    return [slice(start, stop + extra) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


def segments(log: FlightLog) -> list[slice]:
    """Find the maximal runs of at least two samples joined by sound intervals."""
    return runs_of(sound_intervals(log), 1)


def even_segments(log: FlightLog) -> list[slice]:
    """Return the segments; raise ValueError if samples are not evenly spaced within one."""
    uneven = unevenness(log)
    if uneven.any():
        at, after = log.t[int(uneven.argmax()) :][:2]
        found = f"the interval at {at:.6g} s is {after - at:.6g} s, the median is {log.dt:.6g} s"
        raise ValueError(f"{log.name}: {found}; resample the log first: dt={log.dt:.6g}")
    return segments(log)


def unevenness(log: FlightLog) -> Bool[np.ndarray, " n-1"]:
    """Whether each sound interval differs in length from the median."""
    return sound_intervals(log) & (np.abs(np.diff(log.t) - log.dt) > JITTER * log.dt)
