"""Figures of the paper's experiments: scores against N (Figs. 3 and 5), methods ranked (Table 2), ablations."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.paper.lanes import MODELS, Cell, adapted_sizes, by_domain, cells, gain, method_label, ranked
from experiments.paper.tables import value_label
from experiments.reporting import plots
from experiments.reporting.names import FINE_TUNED, HYBRID, SOURCE_ONLY, TARGET_ONLY, label
from experiments.reporting.plots import DRAWABLE, STYLE, Line, colour, note, subplots
from experiments.reporting.results import Column, Results

DASHES = {FINE_TUNED: "-", TARGET_ONLY: "--", SOURCE_ONLY: ":"}
MARKERS = {FINE_TUNED: "o", TARGET_ONLY: "s", SOURCE_ONLY: ""}
# What lies beyond these is marked at the edge of its panel, so that one failed run does not flatten the rest.
LOWEST_RHO = -1.0
DECADES = 6  # of error, from the smallest mean up
HOME = "hybrid before the change"  # the label of its error on source flights


class _Curve(NamedTuple):
    """At each N: mean and std of the finite values, the smallest, and the count of values that are not finite."""

    n: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    smallest: np.ndarray
    failed: np.ndarray
    seeds: np.ndarray


_Curves = dict[tuple[str, str], _Curve]  # by model and mode


@mpl.rc_context(STYLE)
def scores(rows: Results, title: str, floor: float = 0.0) -> Figure:
    """Figs. 3 and 5: test error, above the attainable floor, and ρ against N; mean ± std over seeds."""
    figure, ((left, right),) = subplots(3.8, 1, 2)
    errors, gains = _curves(rows, "test_mse"), _curves(rows.where(mode=(FINE_TUNED, TARGET_ONLY)), gain)
    _draw_errors(left, errors, floor)
    home = rows.where(lambda row: "source_mse" in row)
    for model in [model for model in MODELS if model in home["model"]][:1]:
        error = home.where(model=model).spread("source_mse").mean
        if 1 / DRAWABLE < error < DRAWABLE:
            left.axhline(error, color=colour(model), linestyle=(0, (6, 2, 1, 2)), linewidth=1, label=HOME)
            left.set_ylim(bottom=min(left.get_ylim()[0], error / 2))
    lows = [low for curve in gains.values() for low in curve.mean - curve.std if np.isfinite(low)]
    right.axhline(0.0, color="0.4", linestyle=":")
    right.set(ylabel="gain ρ (1 is perfect; ▽: off the scale)")
    _draw(right, gains, max(LOWEST_RHO, min([*lows, 0.0])) - 0.1, 1.08, lost_at_top=False)
    sizes = adapted_sizes(rows)
    for axes in (left, right):
        axes.set_xlabel("N, target trajectories")
        axes.set_xticks(sizes, [str(n) for n in sizes])
    # Colours of the models, then lines of the ways to train them.
    models, modes = (dict.fromkeys(key[i] for key in errors) for i in (0, 1))
    entries: dict[str, Artist] = {label(model): Line2D([], [], color=colour(model), linewidth=4) for model in models}
    style = {"color": "0.2", "markersize": 4}
    entries |= {label(mode): Line2D([], [], ls=DASHES[mode], marker=MARKERS[mode], **style) for mode in modes}
    # Lines of no model: words beside them would lie on other lines.
    others = {str(line.get_label()): line for line in left.get_lines()}
    entries |= {name: others[name] for name in (HOME, plots.FLOOR) if name in others}
    return plots.legend_of(entries, figure, title, "line: mean over seeds; band: standard deviation")


def ranking(rows: Results, title: str, floors: Mapping[str, float] = MappingProxyType({})) -> Figure:
    """Table 2: test errors of all seeds of every method, the best on top; a panel and a floor for each domain."""
    several = len(adapted_sizes(rows)) > 1

    def line(cell: Cell, own: Results) -> Line:
        name = f"{method_label(cell)}, N = {cell[2]}" if several and cell[2] else method_label(cell)
        marked = "mean of the adapted hybrid" if cell[:2] == (HYBRID, FINE_TUNED) else ""
        return Line(name, own.numbers("test_mse"), colour(cell[0]), marked)

    panels = {domain: [line(*item) for item in ranked(group).items()] for domain, group in by_domain(rows).items()}
    return _error_panels(panels, title, floors)


def ablation(rows: Results, title: str, floors: Mapping[str, float]) -> Figure:
    """Draw the fine-tuned models of one choice, as in `ranking`: a line for each value and N."""
    sizes = adapted_sizes(rows)

    def line(own: Results, n: int) -> Line:
        tint, marked = (colour(HYBRID), "mean of the default") if own[0]["default"] else ("0.35", "")
        name = f"{value_label(own[0])}, N = {n}" if len(sizes) > 1 else value_label(own[0])
        return Line(name, own.numbers("test_mse"), tint, marked if n == sizes[0] else "")

    panels = {
        domain: [line(own, n) for n in sizes for own in group.where(n_train=n).group("value").values()]
        for domain, group in by_domain(rows.where(mode=FINE_TUNED)).items()
    }
    return _error_panels(panels, title, floors)


@mpl.rc_context(STYLE)
def _error_panels(panels: Mapping[str, Sequence[Line]], title: str, floors: Mapping[str, float]) -> Figure:
    counts = [len(lines) for lines in panels.values()]
    height = 0.8 + sum(0.9 + 0.34 * count for count in counts)
    figure, column = subplots(height, len(panels), 1, height_ratios=counts)
    for axes, (domain, lines) in zip(column.flat, panels.items(), strict=True):
        plots.error_panel(axes, lines, label(domain).capitalize(), floors.get(domain, 0.0))
    failed = any(np.isinf(line.errors).any() for lines in panels.values() for line in lines)
    return plots.error_legend(figure, title, failed)


def _curves(rows: Results, value: Column) -> _Curves:
    points = defaultdict(list)
    for (model, mode, n), group in cells(rows).items():
        values = group.numbers(value)
        finite = values[np.abs(values) < DRAWABLE]
        mean, std = finite.mean() if len(finite) else math.nan, finite.std(ddof=1) if len(finite) > 1 else 0.0
        points[model, mode].append(
            (n, mean, std, min(finite, default=math.nan), len(values) - len(finite), len(values))
        )
    return {key: _Curve(*np.array(found, float).T) for key, found in points.items()}


def _draw_errors(axes: Axes, curves: _Curves, floor: float) -> None:
    means = np.concatenate([curve.mean for curve in curves.values()])
    means = means[means > 1 / DRAWABLE]
    lowest, drawn = min(means, default=1.0), floor > 1 / DRAWABLE
    axes.set(yscale="log", ylabel="mean squared error over 1 s, SI units\n(log scale; lower is better)")
    trained = {key: curve for key, curve in curves.items() if key[1] != SOURCE_ONLY}
    bottom = min(lowest, floor) / 2 if drawn else lowest / 2
    _draw(axes, trained, bottom, min(2 * max(means, default=1.0), lowest * 10.0**DECADES))
    for (model, mode), curve in curves.items():
        if mode == SOURCE_ONLY and np.isfinite(curve.mean[0]):
            low, high = _band(axes, curve)
            axes.axhspan(low[0], high[0], color=colour(model), alpha=0.12, linewidth=0)
            axes.axhline(curve.mean[0], color=colour(model), linestyle=":", label=label(model, mode))
    if drawn:
        axes.axhline(floor, color="0.4", linestyle="-.", label=plots.FLOOR)
    plots.tick_errors(axes.yaxis, *axes.get_ylim(), room=3.5)


def _band(axes: Axes, curve: _Curve) -> tuple[np.ndarray, np.ndarray]:
    """Draw one std about the mean, cut at the best seed if it reaches below 0 on a log axis."""
    low = curve.mean - curve.std
    low = np.where(low > 0, low, curve.smallest) if axes.get_yscale() == "log" else low
    return low, curve.mean + curve.std


def _draw(axes: Axes, curves: _Curves, bottom: float, top: float, lost_at_top: bool = True) -> None:
    """Draw within [bottom, top], the spread as a band; mark values outside or not finite."""
    axes.set_ylim(bottom, top)
    for (model, mode), curve in curves.items():
        inside = (curve.mean >= bottom) & (curve.mean <= top)
        mean, low, high = (np.where(inside, p.clip(bottom, top), np.nan) for p in (curve.mean, *_band(axes, curve)))
        style = {"color": colour(model), "linestyle": DASHES[mode], "marker": MARKERS[mode], "markeredgewidth": 0}
        axes.plot(curve.n, mean, label=label(model, mode), **style)
        axes.fill_between(curve.n, low, high, color=colour(model), alpha=0.15, linewidth=0)
        for n, at, _, _, failed, seeds in zip(*curve, strict=True):
            words = f"{failed:.0f}/{seeds:.0f} not finite" if failed else ""
            if math.isnan(at):  # no seed is finite
                marker, y = "x", top if lost_at_top else bottom
            elif bottom <= at <= top:
                marker, y = "o", at
            else:
                marker, y, words = "^" if at > top else "v", top if at > top else bottom, f"{at:.2g} {words}".strip()
            if words:
                white = {"color": colour(model), "markerfacecolor": "white", "markersize": 6}
                axes.plot(n, y, marker, clip_on=False, zorder=5, **white)
                down = y == top
                note(
                    axes,
                    words.replace("-", "−"),
                    (n, y),
                    (5, -5 if down else 5),
                    va="top" if down else "bottom",
                    color=colour(model),
                )
