"""Figures of models on recorded flights: errors against horizon and N, a predicted flight, output of the network."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from experiments.real_flight.rows import QUANTITIES, SUM, Cell, cell_name, cells, pooled, score_labels
from experiments.reporting.plots import COLOURS, STYLE, legend_below
from experiments.reporting.results import Results
from hybrid_jax.state import BODY_RATES, POSITION, VELOCITY

BASELINE_COLOURS = {"linear_residual": "#CC79A7", "thrust": "0.35", "hold": "0.65"}
DASHES = {"fine_tuned": "-", "source_only": "-", "scratch": "--", "zero_shot": ":", "nominal": "-."}
BINS = 12
MIN_SAMPLES = 10  # of a bin that is drawn
OFFSET = 1.02  # factor in N between the points of two models
MARGIN = 1.5  # factor in N on both sides of a single one


class Curve(NamedTuple):
    """Errors at every step, in the order of QUANTITIES: mean over seeds and their standard deviation."""

    mean: Float[np.ndarray, "4 t"]
    std: Float[np.ndarray, "4 t"]


class Restarted(NamedTuple):
    """Predictions of one model, each from a measured state: time [s] and states of each piece."""

    name: str
    colour: str
    pieces: Sequence[tuple[np.ndarray, np.ndarray]]


@mpl.rc_context(STYLE)
def errors_by_step(curves: Mapping[Cell, Curve], dt: float, title: str, measure: str) -> Figure:
    """A panel for each quantity: the error of every model against the time since the start of the prediction.

    Args:
        measure: what an error is, such as "RMSE".
    """
    figure = Figure(figsize=(9.5, 7.2), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True)
    for index, (axes, (name, unit)) in enumerate(zip(panels.flat, QUANTITIES.items(), strict=True)):
        for cell, curve in curves.items():
            _draw_curve(axes, cell, dt * np.arange(1, curve.mean.shape[1] + 1), curve.mean[index], curve.std[index])
        axes.set(yscale="log", title=name.replace("_", " ").capitalize(), ylabel=f"{measure} [{unit}]")
        _tick(axes)
    for axes in panels[1]:
        axes.set_xlabel("time since the start of the prediction [s]")
    return legend_below(figure, title, "mean over seeds; band: ± one standard deviation")


@mpl.rc_context(STYLE)
def errors_by_size(rows: Results, dt: float, title: str) -> Figure:
    """A row of panels for each horizon: the error against N; models without target windows are horizontal lines."""
    found = cells(rows)
    sizes = sorted({n for _, _, n in found} - {0})
    labels = score_labels(rows)
    figure = Figure(figsize=(12, 0.9 + 2.7 * len(labels)), layout="constrained")
    panels = figure.subplots(len(labels), len(QUANTITIES), squeeze=False, sharex=True)
    for label, line in zip(labels, panels, strict=True):
        for (name, unit), axes in zip(QUANTITIES.items(), line, strict=True):
            _draw_sizes(axes, found, sizes, label, name)
            axes.set(title=f"{name.replace('_', ' ').capitalize()}, {_when(label, dt)}", ylabel=f"error [{unit}]")
    for axes in panels[-1]:
        axes.set(xscale="log", xlabel="N, target windows")
        axes.set_xticks(sizes, [str(size) for size in sizes])
        axes.xaxis.set_minor_formatter(NullFormatter())
        if len(sizes) == 1:
            axes.set_xlim(sizes[0] / MARGIN, sizes[0] * MARGIN)
    return legend_below(figure, title, "mean over seeds; bars: ± one standard deviation")


@mpl.rc_context(STYLE)
def predicted_flight(
    time: Float[np.ndarray, " t"], truth: Float[np.ndarray, "t 13"], models: Sequence[Restarted], title: str
) -> Figure:
    """Velocity and body rates of a part of one test flight, and predictions that restart from it at intervals."""
    figure = Figure(figsize=(12, 6), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True)
    places = [*range(*VELOCITY.indices(13)), *range(*BODY_RATES.indices(13))]
    for axes, place, name in zip(panels.flat, places, ("vx", "vy", "vz", "ωx", "ωy", "ωz"), strict=True):
        axes.plot(time, truth[:, place], color="black", linewidth=1.6, label="measured")
        low, high = truth[:, place].min(), truth[:, place].max()
        room = 0.5 * (high - low) or 1.0
        for model in models:
            for index, (at, states) in enumerate(model.pieces):
                label = model.name if index == 0 else None
                axes.plot(at, states[:, place], color=model.colour, linewidth=1.2, label=label)
                axes.plot(at[:1], states[:1, place], ".", color="black", markersize=4)
        axes.set(title=f"{name} [{'m/s' if name[0] == 'v' else 'rad/s'}]", ylim=(low - room, high + room))
    for axes in panels[1]:
        axes.set_xlabel("time in flight [s]")
    return legend_below(figure, title, "each prediction starts at a dot, from the measured state")


@mpl.rc_context(STYLE)
def residual_by_speed(
    speed: Float[np.ndarray, " n"], residuals: Mapping[str, Float[np.ndarray, "n 13"]], title: str
) -> Figure:
    """Output of a network on test flights in ṗ, v̇ and ω̇ against speed: median and quartiles of equal bins.

    Derivatives that no network changes have no panel.

    Args:
        residuals: addition to ẋ at each sample, by the label of the model.
    """
    every = {r"$\dot{p}$ [m/s]": POSITION, r"$\dot{v}$ [m/s²]": VELOCITY, r"$\dot{\omega}$ [rad/s²]": BODY_RATES}
    parts = {name: part for name, part in every.items() if any(each[:, part].any() for each in residuals.values())}
    figure = Figure(figsize=(4 * max(len(parts), 1), 4.2), layout="constrained")
    panels = figure.subplots(1, max(len(parts), 1), squeeze=False)[0][: len(parts)]
    colours = (COLOURS["hybrid"], COLOURS["no_physics"], COLOURS["physics_only"])
    for axes, (name, part) in zip(panels, parts.items(), strict=True):
        for colour, (model, residual) in zip(colours, residuals.items(), strict=False):
            _draw_bins(axes, speed, np.linalg.norm(residual[:, part], axis=1), colour, model)
        axes.set(xlabel="speed [m/s]", ylabel=f"added to {name}", ylim=(0, None))
    return legend_below(figure, title, "median over the samples of a bin; band: quartiles")


def colour_of(model: str) -> str:
    """The colour that a model has in every figure."""
    return (COLOURS | BASELINE_COLOURS)[model]


def _draw_curve(axes: Axes, cell: Cell, time: np.ndarray, mean: np.ndarray, std: np.ndarray) -> None:
    model, mode, _ = cell
    colour = colour_of(model)
    axes.plot(time, mean, DASHES[mode], color=colour, label=cell_name(*cell))
    axes.fill_between(time, np.maximum(mean - std, 0.5 * mean), mean + std, color=colour, alpha=0.15, linewidth=0)


def _draw_sizes(axes: Axes, found: Mapping[Cell, Results], sizes, label: str, quantity: str) -> None:
    drawn = dict.fromkeys((model, mode) for model, mode, _ in found)
    adapted = [each for each in drawn if (*each, 0) not in found]
    for model, mode in drawn:
        own = [(n, pooled(found[model, mode, n], label, quantity)) for n in (0, *sizes) if (model, mode, n) in found]
        name, colour = cell_name(model, mode), colour_of(model)
        if own[0][0] == 0:
            axes.axhline(own[0][1].mean(), color=colour, linestyle=DASHES[mode], linewidth=1.2, label=name)
            continue
        means = [values.mean() for _, values in own]
        spread = [values.std(ddof=1) if len(values) > 1 else 0.0 for _, values in own]
        # Offset, or bars would hide each other.
        factor = OFFSET ** (adapted.index((model, mode)) - (len(adapted) - 1) / 2)
        at = [n * factor for n, _ in own]
        style: dict[str, Any] = {"color": colour, "linestyle": DASHES[mode], "marker": "o", "markersize": 3.5}
        axes.errorbar(at, means, spread, capsize=2, label=name, **style)
    axes.set_yscale("log")
    _tick(axes)


def _tick(axes: Axes) -> None:
    """Plain numbers at 1, 2 and 5 of each decade."""
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _draw_bins(axes: Axes, speed: np.ndarray, size: np.ndarray, colour: str, label: str) -> None:
    edges = np.linspace(0, np.quantile(speed, 0.995), BINS + 1)
    inside = [size[(speed >= low) & (speed < high)] for low, high in pairwise(edges)]
    kept = [index for index, values in enumerate(inside) if len(values) >= MIN_SAMPLES]
    if not kept:
        return
    middle = [(edges[index] + edges[index + 1]) / 2 for index in kept]
    low, median, high = np.array([np.quantile(inside[index], (0.25, 0.5, 0.75)) for index in kept]).T
    axes.plot(middle, median, color=colour, marker="o", markersize=3.5, label=label)
    axes.fill_between(middle, low, high, color=colour, alpha=0.18, linewidth=0)


def _when(label: str, dt: float) -> str:
    return "summed over 50 steps" if label == SUM else f"{int(label) * dt:.3g} s"
