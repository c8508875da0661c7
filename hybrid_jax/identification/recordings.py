"""Windows of recordings, each with an estimate of its initial state from earlier samples."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy
from jaxtyping import Float

from hybrid_jax import checks
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.estimation.shooting import Segments
from hybrid_jax.flights.attitude import interpolate, quaternion_of, rotation_of
from hybrid_jax.flights.checks.airborne import airborne
from hybrid_jax.flights.recording import AXES, Recording, Signal
from hybrid_jax.identification import slow_commands
from hybrid_jax.identification.multirotor import MEASURED
from hybrid_jax.records import integral
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, STATE_SIZE, VELOCITY

UNKNOWN = {"velocity": 2.0, "tilt": 0.3, "rates": 1.0}  # spread of unmeasured states: m/s, rad, rad/s
WARM = 0.4  # s of commands before a window, which determine the rotor speeds at its start


@dataclass(frozen=True)
class Layout:
    """How recordings are cut into windows.

    Attributes:
        dt: the solver's step, and the interval at which measurements are compared [s].
        steps: number of intervals of a window.
        most: maximum number of windows, spread evenly; `identify` chooses half by their information.
        span: duration of the samples before a window from which its initial state is estimated [s].
        disturbance: initial standard deviation of a window's constant disturbances (6), 0 for none: along x, y and z
            [m/s²], and about x, y and z [rad/s²].

    Raises:
        ValueError: if a number is out of range.
    """

    dt: float = 0.01
    steps: int = 50
    most: int = 400
    span: float = 0.1
    disturbance: tuple[float, ...] = (1.0, 1.0, 1.0, 5.0, 5.0, 5.0)

    def __post_init__(self):
        for name in ("dt", "span"):
            checks.positive(name, getattr(self, name), "a positive number of seconds")
        checks.count("steps", self.steps)
        checks.count("most", self.most)

    @property
    def ahead(self) -> int:
        """The number of intervals of commands before a window."""
        return round(WARM / self.dt)


class Windows(NamedTuple):
    """n windows of t intervals."""

    segments: Segments  # their inputs and measurements, one segment each
    centres: Float[np.ndarray, "n d"]  # estimate of each initial state, without rotor speeds (n, 19)
    spread: Float[np.ndarray, "n e"]  # standard deviations of its error (n, 18); 0 if exact
    between: Float[np.ndarray, "n i 2"]  # intervals between samples of slow commands, after the first input [s]


def cut(
    recordings: Sequence[Recording], layout: Layout, motor: str, measured: Sequence[str], most: int, volts: bool = False
) -> tuple[Windows, dict[str, tuple[int, ...]], Float[np.ndarray, "m k"]]:
    """Return windows in flight without gaps, the compared axes, and the root of `slow_commands`.

    `motor` is the input, "command" or "rotor_speed", whose last channel may be `volts`. ValueError if a recording lacks
    a quantity or no window is left.
    """
    found = [name for name in MEASURED if name != motor and all(name in each.signals for each in recordings)]
    names = tuple(measured) or tuple(found)
    for each, name in ((each, name) for each in recordings for name in (motor, *names) if name not in each.signals):
        raise ValueError(f"{each.name}: has no {name}, needed to identify; it has {', '.join(each.signals)}")
    starts = [_starts(each, layout, motor, names) for each in recordings]
    counts = [len(each) for each in starts]
    if not sum(counts):
        span, needed = layout.dt * layout.steps, ", ".join((motor, *names))
        past = f"after {max(layout.span, WARM):.3g} s of the past"
        raise ValueError(f"{recordings[0].name}: no {span:.3g} s in flight without a gap in {needed}, {past}")
    kept = np.unique(np.linspace(0, sum(counts) - 1, most).round().astype(int))
    signals = [each.signals[motor] for each in recordings]
    root = slow_commands.root(signals)
    most, parts, first = max(slow_commands.count(each, layout.dt * layout.steps) for each in signals), [], 0
    for each, own in zip(recordings, starts, strict=True):
        own, first = own[kept[(kept >= first) & (kept < first + len(own))] - first], first + len(own)
        if len(own):
            parts.append(_windows(each, layout, motor, names, own, most, volts))
    axes = {name: _columns_of(name, recordings) for name in names}
    return jax.tree.map(lambda *each: np.concatenate(each), *parts), axes, np.pad(root, ((0, volts), (0, 0)))


def _columns_of(name: str, recordings: Sequence[Recording]) -> tuple[int, ...]:
    """Return the measured axes of a quantity; ValueError unless the recordings agree."""
    axes = recordings[0].signals[name].axes
    for each in (each for each in recordings if each.signals[name].axes != axes):
        raise ValueError(f"{each.name}: {name} must have axes {axes} like the others, got {each.signals[name].axes}")
    known = AXES[name][0] if name in AXES else axes
    return tuple(map(known.index, axes))


def _starts(recording: Recording, layout: Layout, motor: str, names) -> Float[np.ndarray, " n"]:
    """Return the start times of consecutive windows [s] that are in flight, together with their past."""
    signals, length, before = recording.signals, layout.dt * layout.steps, max(layout.span, WARM)
    first, last = (limit(signals[name].t[end] for name in (motor, *names)) for limit, end in ((max, 0), (min, -1)))
    starts = np.arange(first + before, last - length, length)
    begin, end, flown = starts - before, starts + length, airborne(recording, motor)
    clear = np.any([(begin >= off) & (end <= landed) for off, landed in flown] or [np.zeros(len(begin))], axis=0)
    for left, right in (gap for name in (motor, *names) for gap in signals[name].gaps()):
        clear &= (end < left) | (begin > right)
    return starts[clear]


def _windows(recording: Recording, layout: Layout, motor: str, names, starts, most: int, volts: bool) -> Windows:
    signals, n, command = recording.signals, len(starts), recording.signals[motor]
    edges = starts[:, None] + layout.dt * np.arange(-layout.ahead, layout.steps + 1)
    area = integral(command, edges.ravel(), "linear" if slow_commands.is_slow(command) else "held")
    u = np.diff(area.reshape(*edges.shape, -1), axis=1) / layout.dt
    between = slow_commands.spans(command, edges[:, 0], edges[:, -1], most)
    if volts:
        battery = signals["voltage"]
        u = np.concatenate([u, interpolate((edges[:, 1:] + edges[:, :-1]) / 2, battery.t, battery.values)], axis=2)
    y, there = {}, {}
    for name in names:
        values, known = resampled(signals[name], edges[:, layout.ahead + 1 :], layout.dt)
        y[name], there[name] = values[:, None], known[:, None]
    index: Any = {name: np.tile(np.arange(layout.steps), (n, 1, 1)) for name in names}
    segments = Segments(u[:, None], np.ones((n, 1, layout.steps), bool), y, there, index, None)
    start, spread = initial_states(recording, starts, layout)
    start = np.concatenate([start, np.zeros((n, 6))], axis=1)
    return Windows(segments, start, np.concatenate([spread, np.tile(layout.disturbance, (n, 1))], axis=1), between)


def resampled(signal: Signal, t: Float[np.ndarray, "n t"], dt: float):
    """Resample a signal at times dt apart, and return where it exists: a slow signal only at the nearest times.

    A signal with more than two samples in dt is averaged over dt, without delay; attitudes are never averaged.
    """
    values, attitude = np.asarray(signal.values), set(signal.axes) == set(AXES["attitude"][0])
    if attitude:
        values = values * np.cumprod([1.0, *np.where((values[1:] * values[:-1]).sum(axis=1) < 0, -1.0, 1.0)])[:, None]
        found = interpolate(t, signal.t, values)
        found /= np.linalg.norm(found, axis=-1, keepdims=True)
    elif signal.interval < dt / 2:
        ends = [integral(signal, t.ravel() + side * dt / 2, "linear") for side in (-1, 1)]
        found = ((ends[1] - ends[0]) / dt).reshape(*t.shape, -1)
    else:
        found = interpolate(t, signal.t, values)
    near = np.searchsorted(signal.t, t.ravel() - dt / 2), np.searchsorted(signal.t, t.ravel() + dt / 2)
    there = (near[1] > near[0]).reshape(t.shape) | (signal.interval <= 1.5 * dt)
    return found, there & (t >= signal.t[0]) & (t <= signal.t[-1])


def initial_states(
    recording: Recording, starts: Float[np.ndarray, " n"], layout: Layout
) -> tuple[Float[np.ndarray, "n 13"], Float[np.ndarray, "n 12"]]:
    """Fit a quadratic to the samples up to each time; return the states and their standard deviations.

    Unmeasured velocity and rates are the slopes of position and attitude; other unmeasured states are zero with the
    deviations of `UNKNOWN`; unknown position and heading are exact by choice of the origin.
    """
    n, signals = len(starts), recording.signals
    x, spread = np.zeros((n, STATE_SIZE)), np.zeros((n, RIGID_BODY_SPACE.tangent_size))
    x[:, QUATERNION.start] = 1
    spread[:, 3:5], spread[:, 6:9], spread[:, 9:] = UNKNOWN["tilt"], UNKNOWN["velocity"], UNKNOWN["rates"]
    if "position" in signals:
        value, error, slope, slope_error = fitted(signals["position"], starts, layout)
        x[:, POSITION], spread[:, :3] = value, error
        x[:, VELOCITY], spread[:, 6:9] = slope, slope_error
    if "attitude" in signals:
        every = rotation_of(np.asarray(signals["attitude"].values))

        def from_last(part: slice) -> np.ndarray:
            return (every[part.stop - 1].inv() * every[part]).as_rotvec()

        change, spread[:, 3:6], slope, slope_error = fitted(signals["attitude"], starts, layout, from_last)
        last = every[np.clip(np.searchsorted(signals["attitude"].t, starts, side="right") - 1, 0, None)]
        x[:, QUATERNION] = quaternion_of(last * scipy.spatial.transform.Rotation.from_rotvec(change))
        x[:, BODY_RATES], spread[:, 9:] = slope, slope_error
    for name, place, at in (("velocity", VELOCITY, 6), ("rates", BODY_RATES, 9)):
        if name in signals and len(signals[name].axes) == 3:
            x[:, place], spread[:, at : at + 3] = fitted(signals[name], starts, layout)[:2]
    if "body_velocity" in signals and len(signals["body_velocity"].axes) == 3:
        value, error, *_ = fitted(signals["body_velocity"], starts, layout)
        x[:, VELOCITY], spread[:, 6:9] = rotation_of(x[:, QUATERNION]).apply(value), error
    return x, spread


def fitted(signal: Signal, starts: Float[np.ndarray, " n"], layout: Layout, numbers: Callable | None = None):
    """Fit a quadratic to the last samples; return its value (n, k), the standard deviation (k), slope and deviation.

    It uses the samples of `layout.span`, but at least six if there are so many; `numbers` converts them.
    """
    found = []
    for t in starts:
        end = int(np.searchsorted(signal.t, t, side="right"))
        part = slice(max(0, min(int(np.searchsorted(signal.t, t - layout.span)), end - 6)), max(end, 1))
        values = np.asarray(signal.values)[part] if numbers is None else numbers(part)
        basis = (signal.t[part] - t)[:, None] ** np.arange(3 if len(values) > 4 else 2)
        weights = np.linalg.lstsq(basis, values, rcond=None)[0]
        variance = ((values - basis @ weights) ** 2).sum(axis=0) / max(len(basis) - basis.shape[1], 1)
        found.append((*weights[:2], variance, np.sqrt(np.diagonal(np.linalg.pinv(basis.T @ basis)))[:2]))
    value, slope, variance, gains = (np.array(part) for part in zip(*found, strict=True))
    noise, (of_value, of_slope) = np.sqrt(np.median(variance, axis=0)), np.median(gains, axis=0)
    return value, noise * of_value, slope, noise * of_slope
