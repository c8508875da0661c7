"""Windows of recordings, each with an estimate of its initial state from the samples before it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import numpy as np
import scipy
from jaxtyping import Bool, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.measurement import MEASURED
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.flights.checks.airborne import airborne
from hybrid_jax.flights.recording import AXES, Recording, Signal
from hybrid_jax.identification import slow_commands
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, STATE_SIZE, VELOCITY

Initial = Literal["estimated", "sample"]
UNKNOWN = {"velocity": 2.0, "tilt": 0.3, "rates": 1.0}  # spread of what nothing measures: m/s, rad, rad/s
WARM = 0.3  # s
PADDING = 1024
BREAK = 10.0  # s between two recordings on the common clock


@dataclass(frozen=True)
class Layout:
    """How recordings are cut into windows.

    Attributes:
        dt: of the solver's steps and of the grid on which measurements are compared [s].
        steps: intervals of a window.
        most: windows at most, spread evenly; of those that `identify` fits, half are those that tell most.
        span: of the samples before a window that its initial state is estimated from [s].
        initial: "estimated" from these samples, or "sample", the last one before the window, taken as exact.
        warm: of the commands before a window that the rotors' speeds at its start follow from [s].
        disturbance: first guess of the standard deviation of a window's constant disturbances (6), 0 for none: along x,
            y and z [m/s²], and about x, y and z [rad/s²].

    Raises:
        ValueError: a number out of range, or an unknown `initial`.
    """

    dt: float = 0.01
    steps: int = 50
    most: int = 400
    span: float = 0.1
    initial: Initial = "estimated"
    warm: float = WARM
    disturbance: tuple[float, ...] = (1.0, 1.0, 1.0, 5.0, 5.0, 5.0)

    def __post_init__(self):
        for name in ("dt", "span"):
            checks.positive(name, getattr(self, name), "a positive number of seconds")
        checks.not_negative("warm", self.warm)
        checks.count("steps", self.steps)
        checks.count("most", self.most)
        if self.initial not in Initial.__args__:
            raise ValueError(f"initial must be one of {', '.join(Initial.__args__)}, got {self.initial!r}")

    @property
    def ahead(self) -> int:
        """Intervals of commands before a window."""
        return round(self.warm / self.dt)


class Windows(NamedTuple):
    """n windows of t intervals, on a clock common to all recordings."""

    edges: Float[np.ndarray, "n ahead+t+1"]  # of the intervals [s]
    voltage: Float[np.ndarray, "n ahead+t"]  # V; 0 if unknown
    y: dict[str, Float[np.ndarray, "n t k"]]  # at the end of each interval, by quantity; 0 where there is none
    there: dict[str, Bool[np.ndarray, "n t"]]
    start: Float[np.ndarray, "n 13"]
    spread: Float[np.ndarray, "n 12"]  # standard deviation of its error; 0 of what is taken as exact
    recording: Float[np.ndarray, " n"]  # which of them
    between: Float[np.ndarray, "n i 2"]  # intervals between samples of slow commands [s]; none of fast ones


class Inputs(NamedTuple):
    """The commands, or measured rotor speeds, of all recordings on the common clock, each held until the next."""

    t: Float[np.ndarray, " s"]
    values: Float[np.ndarray, "s m"]
    root: Float[np.ndarray, "m m"]  # of the covariance of what slow commands do between samples, see `between`


def cut(
    recordings: Sequence[Recording], layout: Layout, told: str, measured: Sequence[str], most: int
) -> tuple[Windows, Inputs, dict[str, tuple[int, ...]]]:
    """The windows in flight that no gap crosses, the inputs, and the axes of each quantity that is compared.

    Args:
        told: the quantity that is the field's input, "command" or "rotor_speed".
        measured: what is compared, by default all of `MEASURED` that every recording has, but for the input.
        most: windows at most, spread evenly.

    Raises:
        ValueError: a recording lacks a quantity, or no window is left: name and what was expected.
    """
    found = [name for name in MEASURED if name != told and all(name in each.signals for each in recordings)]
    names = tuple(measured) or tuple(found)
    for each in recordings:
        for name in (told, *names):
            if name not in each.signals:
                raise ValueError(f"{each.name}: has no {name}, needed to identify; it has {', '.join(each.signals)}")
    begin, parts, inputs = 0.0, [], []
    bridges = max(slow_commands.count(each.signals[told], layout.dt * layout.steps) for each in recordings)
    for i, each in enumerate(recordings):
        parts.append(_windows(each, layout, told, names, begin, i, bridges))
        t, values = slow_commands.lines(each.signals[told], layout.dt)
        inputs.append((t + begin, values))
        begin += max(signal.t[-1] for signal in each.signals.values()) + BREAK
    parts = [part for part in parts if len(part.start)]
    if not parts:
        span = layout.dt * layout.steps
        raise ValueError(
            f"{recordings[0].name}: no {span:.3g} s in flight without a gap in {', '.join((told, *names))}"
        )
    windows = jax.tree.map(lambda *each: np.concatenate(each), *parts)
    kept = np.unique(np.linspace(0, len(windows.start) - 1, most).round().astype(int))
    columns = {name: columns_of(name, recordings) for name in names}
    return (
        jax.tree.map(lambda part: part[kept], windows),
        Inputs(
            *_padded(*map(np.concatenate, zip(*inputs, strict=True))),
            slow_commands.root([each.signals[told] for each in recordings]),
        ),
        columns,
    )


def _padded(t: Float[np.ndarray, " s"], values: Float[np.ndarray, "s m"]) -> tuple[np.ndarray, np.ndarray]:
    """The inputs, with the last repeated up to a multiple of `PADDING` samples: logs of like length share a program."""
    more = -len(t) % PADDING
    return np.append(t, t[-1] + 1 + np.arange(more)), np.concatenate([values, np.repeat(values[-1:], more, 0)])


def columns_of(name: str, recordings: Sequence[Recording]) -> tuple[int, ...]:
    """Which axes of a quantity were measured; ValueError unless the recordings agree."""
    axes = recordings[0].signals[name].axes
    for each in recordings:
        if each.signals[name].axes != axes:
            raise ValueError(f"{each.name}: {name} has axes {each.signals[name].axes}, those before {axes}")
    known = AXES[name][0] if name in AXES else axes
    return tuple(map(known.index, axes))


def _windows(recording: Recording, layout: Layout, told: str, names, begin: float, number: int, most) -> Windows:
    signals, length = recording.signals, layout.dt * layout.steps
    before = max(layout.span, layout.warm)
    first, last = (limit(signals[name].t[end] for name in (told, *names)) for limit, end in ((max, 0), (min, -1)))
    starts = np.arange(first + before, last - length, length)
    starts = starts[_clear(recording, told, names, starts - before, starts + length)]
    edges = starts[:, None] + layout.dt * np.arange(-layout.ahead, layout.steps + 1)
    y, there = {}, {}
    for name in names:
        y[name], there[name] = on_grid(signals[name], edges[:, layout.ahead + 1 :], layout.dt)
    voltage = signals.get("voltage")
    volts = np.zeros_like(edges[:, 1:]) if voltage is None else _at(voltage, (edges[:, 1:] + edges[:, :-1]) / 2)[..., 0]
    start, spread = initial_states(recording, starts, layout)
    slow = slow_commands.spans(signals[told], starts + length, most) + begin
    return Windows(edges + begin, volts, y, there, start, spread, np.full(len(starts), number), slow)


def _clear(recording: Recording, told: str, names, begin, end) -> Bool[np.ndarray, " n"]:
    """Whether each span is in flight and meets no gap."""
    flights = airborne(recording, told)
    clear = np.any([(begin >= first) & (end <= last) for first, last in flights] or [np.zeros(len(begin))], axis=0)
    for name in (told, *names):
        for left, right in recording.signals[name].gaps():
            clear &= (end < left) | (begin > right)
    return clear


def _at(signal: Signal, t: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n k"]:
    return np.stack([np.interp(t, signal.t, column) for column in np.asarray(signal.values).T], axis=-1)


def on_grid(signal: Signal, t: Float[np.ndarray, "n t"], dt: float):
    """The signal at times dt apart, and whether there is one: of a slow signal at the time nearest to each sample.

    A signal of more than two samples in dt is the mean over it, without delay; attitudes are never averaged.
    """
    values, attitude = np.asarray(signal.values), set(signal.axes) == set(AXES["attitude"][0])
    if attitude:
        values = values * np.cumprod([1.0, *np.where((values[1:] * values[:-1]).sum(axis=1) < 0, -1.0, 1.0)])[:, None]
    signal = Signal(signal.t, values, signal.axes, signal.source)
    if signal.interval < dt / 2 and not attitude:
        steps = np.diff(signal.t)[:, None] * (values[1:] + values[:-1]) / 2
        area = Signal(signal.t, np.concatenate([0 * values[:1], np.cumsum(steps, axis=0)]), signal.axes, signal.source)
        found = (_at(area, t + dt / 2) - _at(area, t - dt / 2)) / dt
    else:
        found = _at(signal, t)
    if attitude:
        found = found / np.linalg.norm(found, axis=-1, keepdims=True)
    near = np.searchsorted(signal.t, t.ravel() - dt / 2), np.searchsorted(signal.t, t.ravel() + dt / 2)
    there = (near[1] > near[0]).reshape(t.shape) | (signal.interval <= 1.5 * dt)
    return found, there & (t >= signal.t[0]) & (t <= signal.t[-1])


def initial_states(
    recording: Recording, starts: Float[np.ndarray, " n"], layout: Layout
) -> tuple[Float[np.ndarray, "n 13"], Float[np.ndarray, "n 12"]]:
    """The state at each time and the standard deviations of its error, from samples up to that time.

    A quadratic is fitted to the samples of `layout.span` before it; velocity and rates that are not measured are the
    slopes of position and attitude. What nothing measures is zero, with the deviations of `UNKNOWN`; unknown position
    and heading are exact by choice of the origin. With `initial="sample"` the last sample stands, taken as exact.
    """
    n, signals = len(starts), recording.signals
    x, spread = np.zeros((n, STATE_SIZE)), np.zeros((n, RIGID_BODY_SPACE.tangent_size))
    x[:, QUATERNION.start] = 1
    spread[:, 3:5], spread[:, 6:9], spread[:, 9:] = UNKNOWN["tilt"], UNKNOWN["velocity"], UNKNOWN["rates"]
    if "position" in signals:
        value, error, slope, slope_error = fitted(signals["position"], starts, layout)
        _fill(x, spread, POSITION, 0, value, error)
        _fill(x, spread, VELOCITY, 6, slope, slope_error)
    if "attitude" in signals:
        every = _rotation(np.asarray(signals["attitude"].values))

        def from_last(part: slice) -> np.ndarray:
            return (every[part.stop - 1].inv() * every[part]).as_rotvec()

        change, spread[:, 3:6], slope, slope_error = fitted(signals["attitude"], starts, layout, from_last)
        last = every[np.clip(np.searchsorted(signals["attitude"].t, starts, side="right") - 1, 0, None)]
        x[:, QUATERNION] = np.roll((last * scipy.spatial.transform.Rotation.from_rotvec(change)).as_quat(), 1, axis=1)
        _fill(x, spread, BODY_RATES, 9, slope, slope_error)
    for name, place, at in (("velocity", VELOCITY, 6), ("rates", BODY_RATES, 9)):
        if name in signals and len(signals[name].axes) == 3:
            _fill(x, spread, place, at, *fitted(signals[name], starts, layout)[:2])
    if "body_velocity" in signals and len(signals["body_velocity"].axes) == 3:
        value, error, *_ = fitted(signals["body_velocity"], starts, layout)
        _fill(x, spread, VELOCITY, 6, _rotation(x[:, QUATERNION]).apply(value), error)
    return x, spread


def _fill(x, spread, place: slice, at: int, value, error) -> None:
    x[:, place], spread[:, at : at + 3] = value, error


def _rotation(q) -> "scipy.spatial.transform.Rotation":
    return scipy.spatial.transform.Rotation.from_quat(np.roll(q, -1, axis=-1))


def fitted(signal: Signal, starts: Float[np.ndarray, " n"], layout: Layout, numbers: Callable | None = None):
    """Value (n, k), its standard deviation (k), slope and its deviation, of a quadratic through the samples before.

    They are those of `layout.span`, at least six, or as many as there are. With `initial="sample"` the value is that of
    the last one, taken as exact.

    Args:
        numbers: what stands for the samples of a slice of the signal (s, k), by default their values.
    """
    found = []
    for t in starts:
        end = int(np.searchsorted(signal.t, t, side="right"))
        part = slice(max(0, min(int(np.searchsorted(signal.t, t - layout.span)), end - 6)), max(end, 1))
        values = np.asarray(signal.values)[part] if numbers is None else numbers(part)
        past = signal.t[part] - t
        basis = past[:, None] ** np.arange(3 if len(past) > 4 else 2)
        weights = np.linalg.lstsq(basis, values, rcond=None)[0]
        variance = ((values - basis @ weights) ** 2).sum(axis=0) / max(len(basis) - basis.shape[1], 1)
        gains = np.sqrt(np.diagonal(np.linalg.pinv(basis.T @ basis)))[:2]
        found.append((values[-1], *weights[:2], variance, gains))
    if not found:
        none = np.zeros((0, 3 if numbers else len(signal.axes)))
        return none, none.sum(axis=0), none, none.sum(axis=0)
    last, value, slope, variance, gains = (np.array(part) for part in zip(*found, strict=True))
    noise, (of_value, of_slope) = np.sqrt(np.median(variance, axis=0)), np.median(gains, axis=0)
    if layout.initial == "sample":
        value, of_value = last, 0.0
    return value, noise * of_value, slope, noise * of_slope
