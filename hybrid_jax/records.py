"""Measured signals by name, each with its own sample times."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, Self, get_args

import numpy as np
from jaxtyping import Float, Int

from hybrid_jax import checks

GAP = 5.0  # intervals longer than this many times the median are gaps

Between = Literal["held", "linear", "averaged"]


@dataclass(frozen=True)
class Signal:
    """The n samples of one quantity.

    Attributes:
        t: time of each sample [s] from the start of the record, which should increase strictly.
        values: the samples (n, k), with a column for each axis. They should be in SI units.
        axes: the names of the measured axes; by default "0", "1", …
        source: the topic, group or columns that it came from, for messages.

    Raises:
        ValueError: if shapes do not agree, a value is not finite, or times do not increase.
    """

    t: Float[np.ndarray, " n"] = field(repr=False)
    values: Float[np.ndarray, "n k"] = field(repr=False)
    axes: tuple[str, ...] = ()
    source: str = "signal"

    def __post_init__(self):
        t, values = np.array(self.t, float), np.array(self.values, float)
        values = values[:, None] if values.ndim == 1 else values
        axes = self.axes or tuple(map(str, range(values.shape[-1])))
        if t.ndim != 1 or values.shape != (len(t), len(axes)):
            shapes = f"got {t.shape} and {values.shape}"
            raise ValueError(f"{self.source}: t and values must be (n,) and (n, {len(axes)}), {shapes}")
        for row in np.flatnonzero(t[1:] <= t[:-1])[:1] + 1:
            raise ValueError(f"{self.source}: time {t[row]:.6g} s does not come after {t[row - 1]:.6g} s")
        for row, column in np.argwhere(~np.isfinite(values))[:1].tolist():
            axis = axes[column]
            raise ValueError(f"{self.source}: {axis} is {values[row, column]} at {t[row]:.6g} s, must be finite")
        for name, value in (("t", t), ("values", values), ("axes", axes)):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.t)

    @property
    def interval(self) -> float:
        """The median time between samples [s]; infinite for fewer than two."""
        return float(np.median(np.diff(self.t))) if len(self) > 1 else np.inf

    def gaps(self) -> list[tuple[float, float]]:
        """Return start and end [s] of each interval without samples."""
        missing = np.flatnonzero(np.diff(self.t) > GAP * self.interval)
        return [(float(self.t[i]), float(self.t[i + 1])) for i in missing]


@dataclass(frozen=True)
class Record:
    """The signals of one experiment.

    Attributes:
        name: what messages call the experiment, usually its file.
        signals: the signals, by name. You should leave out signals that were not measured.
        notes: what a reader omitted or had to assume, one sentence each.
        facts: metadata of the log, for example {"airframe": "4001"}.
    """

    name: str
    signals: Mapping[str, Signal]
    notes: tuple[str, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str = "record", **signals: tuple) -> "Record":
        """Make a record of arrays, for example `Record.of("run 1", torque=(t, torque), angle=(t_angle, angle))`.

        Args:
            name: what messages call the experiment.
            signals: the times [s] (n,) and values (n,) or (n, k) of each signal; ValueError as for `Signal`. Samples
                with NaN are left out.
        """
        found = {}
        for label, (t, values) in signals.items():
            t, values = np.asarray(t, float), np.asarray(values, float)
            kept = np.isfinite(values.reshape(len(values), -1)).all(axis=1) if len(t) == len(values) else slice(None)
            found[label] = Signal(t[kept], values[kept], source=f"{name}: {label}")
        return cls(name, found)

    @property
    def duration(self) -> float:
        """The length [s] of the longest signal, from its first to its last sample."""
        return max((float(signal.t[-1] - signal.t[0]) for signal in self.signals.values() if len(signal)), default=0.0)

    def part(self, begin: float, end: float) -> Self:
        """Return the samples between two times; times are not shifted.

        Args:
            begin: the first time [s].
            end: the last time [s].
        """
        cut = {}
        for name, signal in self.signals.items():
            inside = (signal.t >= begin) & (signal.t <= end)
            cut[name] = Signal(signal.t[inside], signal.values[inside], signal.axes, signal.source)
        return type(self)(self.name, cut, self.notes, self.facts)


class Gridded(NamedTuple):
    """A record on the solver's grid, with outputs at their own times."""

    start: float  # time of the grid's first point [s]
    u: Float[np.ndarray, "t m"]  # the mean of the inputs over each interval
    y: dict[str, Float[np.ndarray, "n k"]]  # the samples of each output
    index: dict[str, Int[np.ndarray, " n"]]  # the interval that contains each sample
    share: dict[str, Float[np.ndarray, " n"]]  # the position of each sample in its interval, from 0 to 1


def completed(records: Sequence[Record], outputs: Sequence[str], angles: Sequence[str]) -> list[Record]:
    """Return the records with an empty signal for each output that one of them lacks, and angles without jumps."""
    known = {name: each.signals[name].values[:0] for each in records for name in outputs if each.signals.get(name)}
    empty = {name: Signal(np.zeros(0), known.get(name, np.zeros((0, 1)))) for name in outputs}
    given = [{name: signal for name, signal in each.signals.items() if len(signal)} for each in records]
    turned = [
        {k: replace(v, values=np.unwrap(v.values, axis=0)) for k, v in each.items() if k in angles} for each in given
    ]
    return [Record(each.name, empty | own | more) for each, own, more in zip(records, given, turned, strict=True)]


def on_grid(
    record: Record,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    dt: float,
    between: Between = "held",
    begin: float | None = None,
) -> Gridded:
    """Divide a record into intervals of length dt [s] from `begin` [s], over the outputs' samples with known inputs.

    Inputs, which make up u, are "held" until the next sample, interpolated ("linear"), or "averaged" since the last.
    """
    seen = [name for name in outputs if record.signals.get(name)]
    for name in (*inputs, *(() if seen else outputs)):
        if not record.signals.get(name):
            has = [name for name, signal in record.signals.items() if len(signal)]
            raise ValueError(f"{record.name}: has no {name}; it has {', '.join(has) or 'nothing'}")
    if between not in get_args(Between):
        raise ValueError(f"between must be one of {', '.join(get_args(Between))}, got {checks.short_repr(between)}")
    first, end = _span(record, inputs, seen, between)
    if begin is not None and begin < min((record.signals[name].t[0] for name in inputs), default=begin) - dt:
        raise ValueError(f"{record.name}: {', '.join(inputs)} must be known from {begin:.6g} s on")
    begin = first if begin is None else begin
    steps = int(np.ceil((end - begin) / dt - 1e-6))  # the last one may end after the last sample
    if steps < 1:
        raise ValueError(f"{record.name}: {', '.join((*inputs, *outputs))} overlap for less than dt={dt:.3g} s")
    edges = begin + dt * np.arange(steps + 1)
    areas = [integral(record.signals[name], edges, between) for name in inputs]
    u = np.diff(np.concatenate(areas, axis=1), axis=0) / dt if inputs else np.zeros((steps, 0))
    y, index, share = {}, {}, {}
    for name in outputs:
        signal = record.signals[name]
        at = (signal.t - begin) / dt
        inside = (at >= -1e-6) & (at <= steps + 1e-6)
        if name in seen and not inside.any():
            raise ValueError(f"{record.name}: no sample of {name} lies between {begin:.6g} and {end:.6g} s")
        at = np.clip(at[inside], 0, steps)
        index[name] = np.minimum(np.floor(at + 1e-9).astype(int), steps - 1)
        y[name], share[name] = signal.values[inside], np.clip(at - index[name], 0.0, 1.0)
    return Gridded(begin, u, y, index, share)


def _span(record: Record, inputs, outputs, between: Between) -> tuple[float, float]:
    """Return the first and last time with a measured output and known inputs."""
    acting = [record.signals[name] for name in inputs]
    lasting = [signal.interval if between == "held" and len(signal) > 1 else 0.0 for signal in acting]
    begin = max((signal.t[0] - (signal.interval if between == "averaged" else 0) for signal in acting), default=-np.inf)
    end = min((signal.t[-1] + more for signal, more in zip(acting, lasting, strict=True)), default=np.inf)
    measured = [record.signals[name] for name in outputs]
    first, last = min(signal.t[0] for signal in measured), max(signal.t[-1] for signal in measured)
    return max(begin, first), min(end, last)


def integral(signal: Signal, t: Float[np.ndarray, " n"], between: Between) -> Float[np.ndarray, "n k"]:
    """Integrate a signal up to each time [s]; its first and last values continue beyond its ends."""
    edges, values = signal.t, signal.values
    step = np.diff(edges)[:, None]
    parts = {"held": values[:-1], "averaged": values[1:], "linear": (values[1:] + values[:-1]) / 2}[between] * step
    area = np.concatenate([0 * values[:1], np.cumsum(parts, axis=0)])
    i = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, max(len(edges) - 2, 0))
    past = (t - edges[i])[:, None]
    if len(edges) == 1:
        return values[0] * past
    slope = (values[i + 1] - values[i]) / step[i] if between == "linear" else 0.0
    level = values[i + 1] if between == "averaged" else values[i]
    beyond = np.where(t >= edges[-1], t - edges[-1], 0.0)[:, None]  # the last sample goes on
    past = past - beyond
    return area[i] + level * past + slope * past**2 / 2 + values[-1] * beyond
