"""Figures of scores and of physical parameters against N, the number of target trajectories (Figs. 3 and 5)."""

import io
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.paper.claims import THETA_TOLERANCE
from experiments.paper.rows import NAMES, THETA, Row
from experiments.paper.summary import grouped
from hybrid_jax.io.files import write_atomic

STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "svg.hashsalt": "hybrid_jax",  # otherwise names inside an SVG are random
}
# Okabe and Ito's palette, which the colour-blind can tell apart.
COLOURS = {"hybrid": "#0072B2", "no_physics": "#D55E00", "physics_only": "#009E73", "constant_disturbance": "#CC79A7"}
OTHERS = "0.4"  # models that are in no figure of the paper
DASHES = {"fine_tuned": "-", "target_only": "--", "source_only": ":"}
MARKERS = {"fine_tuned": "o", "target_only": "s", "source_only": ""}
# What lies beyond these is marked at the edge of its panel, so that one failed run does not flatten the rest.
LOWEST_RHO = -1.0
DECADES = 6  # of error, from the smallest mean up
LARGEST_BIAS = 100.0  # % of a parameter
DRAWABLE = 1e30  # a number beyond it overflows inside matplotlib and is drawn like one that is not finite


class _Curve(NamedTuple):
    """At each N: of the finite values mean, mean ± one std and smallest; and how many of how many are not finite."""

    n: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    smallest: np.ndarray
    failed: np.ndarray
    seeds: np.ndarray


_Curves = dict[tuple[str, str], _Curve]  # by model and mode


@mpl.rc_context(STYLE)
def scores(rows: Sequence[Row], title: str, floor: float = 0.0) -> Figure:
    """Figs. 3 and 5: test error and ρ against N, mean and one standard deviation over seeds.

    Args:
        floor: an error that no model at hand can get below, such as the share of a wind's sine; 0 if there is none.

    Raises:
        ValueError: no rows.
    """
    if not rows:
        raise ValueError("rows must not be empty: there is nothing to draw")
    figure = Figure(figsize=(9, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_errors(left, _curves(rows, lambda row: row.error), floor)
    _draw_gains(right, _curves([row for row in rows if row.mode != "source_only"], lambda row: row.gain))
    for axes in (left, right):
        axes.set_xlabel("N, target trajectories trained on")
        _tick_sizes(axes, rows)
    _finish(figure, left, title, columns=3)
    return figure


@mpl.rc_context(STYLE)
def theta(rows: Sequence[Row], truth: Mapping[str, float], title: str = "Physical parameters after training") -> Figure:
    """Ix, Iy and k relative to the truth against N, mean and one standard deviation over seeds.

    Args:
        truth: the true value of each; none is 0.

    Raises:
        ValueError: no trained row has parameters.
    """
    known = [row for row in rows if row.theta is not None and row.mode != "source_only"]
    if not known:
        raise ValueError("rows must hold some with theta: there is nothing to draw")
    figure = Figure(figsize=(9, 4.1), layout="constrained")
    panels = figure.subplots(1, len(THETA))
    for axes, name in zip(panels, THETA, strict=True):
        _draw_biases(axes, _curves(known, lambda row, name=name: _bias(row, name, truth)))
        axes.set(title=f"{name}, truly {truth[name]:.4g} {_unit(name)}", xlabel="N, target trajectories")
        _tick_sizes(axes, known)
    panels[0].set_ylabel("recovered / true − 1  [%]")
    _finish(figure, panels[0], title, columns=4)
    return figure


def save_figure(figure: Figure, path: str | Path) -> list[Path]:
    """Write `path`.png and `path`.svg, the same bytes for the same figure; returns the two paths.

    Raises:
        OSError: the folder cannot be written.
    """
    paths = []
    for suffix, metadata in (("png", {}), ("svg", {"Date": None})):
        content = io.BytesIO()
        with mpl.rc_context(STYLE):
            figure.savefig(content, format=suffix, dpi=150, metadata=metadata)
            figure.set_layout_engine("none")  # both as the first was laid out: that is half of the work
        paths.append(Path(f"{path}.{suffix}"))
        write_atomic(paths[-1], content.getvalue())
    return paths


def colour(model: str) -> str:
    """The colour that a model has in every figure."""
    return COLOURS.get(model, OTHERS)


def _curves(rows: Sequence[Row], value: Callable[[Row], float]) -> _Curves:
    points: dict[tuple[str, str], list[tuple[float, ...]]] = {}
    for (model, mode, n), group in grouped(rows).items():
        points.setdefault((model, mode), []).append((n, *_point(np.array([value(row) for row in group], float))))
    return {key: _Curve(*np.array(found, float).T) for key, found in points.items()}


def _point(values: np.ndarray) -> tuple[float, ...]:
    finite = values[np.abs(values) < DRAWABLE]
    failed = len(values) - len(finite)
    if not len(finite):
        return math.nan, math.nan, math.nan, math.nan, failed, len(values)
    mean, std = finite.mean(), finite.std(ddof=1) if len(finite) > 1 else 0.0
    return mean, mean - std, mean + std, finite.min(), failed, len(values)


def _draw_errors(axes: Axes, curves: _Curves, floor: float) -> None:
    means = np.concatenate([curve.mean for curve in curves.values()])
    means = means[means > 1 / DRAWABLE]
    lowest = min(means, default=1.0)
    limits = lowest / 2, min(2 * max(means, default=1.0), lowest * 10.0**DECADES)
    axes.set(yscale="log", ylabel="$L^T_{MSE}$  (state in SI units, squared)", title="Test error (log scale)")
    # One std may reach below 0, which a log axis has not; the whisker then ends at the best seed.
    curves = {key: c._replace(low=np.where(c.low > 0, c.low, c.smallest)) for key, c in curves.items()}
    trained = {key: curve for key, curve in curves.items() if key[1] != "source_only"}
    _draw_curves(axes, trained, min(limits[0], floor / 2) if floor > 1 / DRAWABLE else limits[0], limits[1])
    for (model, mode), curve in curves.items():
        if mode == "source_only" and np.isfinite(curve.mean[0]):
            axes.axhspan(curve.low[0], curve.high[0], color=colour(model), alpha=0.12, linewidth=0)
            axes.axhline(curve.mean[0], color=colour(model), linestyle=":", label=f"{NAMES[model]}, source-only")
    if floor > 1 / DRAWABLE:
        axes.axhline(floor, color="0.4", linestyle="-.", label="floor: what no model here can see")


def _draw_gains(axes: Axes, curves: _Curves) -> None:
    lows = np.concatenate([curve.low for curve in curves.values()] or [np.zeros(1)])
    lowest = max(LOWEST_RHO, min(lows[np.isfinite(lows)], default=0.0))
    axes.axhline(0.0, color="0.4", linestyle=":")
    style = {"ha": "right", "va": "top", "fontsize": 8, "color": "0.4"}
    axes.text(0.99, -0.01, "0: no gain over source-only", transform=axes.get_yaxis_transform(), **style)
    axes.set(ylabel="ρ = 1 − error / source error", title="Improvement over source-only (1 is perfect)")
    _draw_curves(axes, curves, min(lowest, 0.0) - 0.1, 1.08, lost_at_top=False)


def _draw_biases(axes: Axes, curves: _Curves) -> None:
    tolerance = 100 * THETA_TOLERANCE
    axes.axhspan(-tolerance, tolerance, color="0.92", zorder=0, label=f"within {THETA_TOLERANCE:.0%}")
    axes.axhline(0.0, color="black", linewidth=1, label="truth")
    ends = np.abs(np.concatenate([end for curve in curves.values() for end in (curve.low, curve.high)]))
    reach = min(LARGEST_BIAS, max(ends[np.isfinite(ends)], default=0.0))
    _draw_curves(axes, curves, -1.15 * max(reach, tolerance), 1.15 * max(reach, tolerance))


def _draw_curves(axes: Axes, curves: _Curves, bottom: float, top: float, lost_at_top: bool = True) -> None:
    """Draw within [bottom, top], each curve a little beside the next; mark what lies outside or is not finite."""
    axes.set_ylim(bottom, top)
    span = max((np.ptp(curve.n) for curve in curves.values()), default=0.0) or 1.0
    for index, ((model, mode), curve) in enumerate(curves.items()):
        x = curve.n + 0.012 * span * (index - (len(curves) - 1) / 2)
        inside = (curve.mean >= bottom) & (curve.mean <= top)
        mean, low, high = (np.where(inside, np.clip(part, bottom, top), np.nan) for part in curve[1:4])
        style = {"color": colour(model), "linestyle": DASHES[mode], "marker": MARKERS[mode], "markersize": 5}
        whiskers = np.stack([mean - low, high - mean])
        axes.errorbar(x, mean, whiskers, capsize=3, label=f"{NAMES[model]}, {NAMES[mode]}", **style)
        lost = top if lost_at_top else bottom
        for index, at in enumerate(x):
            _mark_failure(axes, at, [part[index] for part in curve], lost, colour(model))


def _mark_failure(axes: Axes, at: float, point: Sequence[float], lost: float, colour: str) -> None:
    """Hollow where some seeds are not finite, an arrow with the number beyond an edge, × at `lost` where none is."""
    _, mean, _, _, _, failed, seeds = point
    bottom, top = axes.get_ylim()
    words = f"{failed:.0f}/{seeds:.0f} not finite" if failed else ""
    marker, y = ("x", lost) if math.isnan(mean) else ("o", mean)
    if mean > top or mean < bottom:
        marker, y = ("^", top) if mean > top else ("v", bottom)
        words = f"{mean:.2g} {words}".strip()
    if words:
        axes.plot(at, y, marker, color=colour, markerfacecolor="white", markersize=6, clip_on=False, zorder=5)
        down = y > axes.transData.inverted().transform(axes.transAxes.transform((0.0, 0.5)))[1]
        offset, align = ((5, -5), "top") if down else ((5, 5), "bottom")
        box = {"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 0.5}
        style = {"va": align, "fontsize": 8, "color": colour, "bbox": box, "zorder": 6}
        axes.annotate(words, (at, y), offset, textcoords="offset points", **style)


def _tick_sizes(axes: Axes, rows: Sequence[Row]) -> None:
    sizes = sorted({row.n_train for row in rows} - {0})
    axes.set_xticks(sizes, [str(size) for size in sizes])
    if not sizes:
        axes.set_xticks([])


def _finish(figure: Figure, axes: Axes, title: str, columns: int) -> None:
    figure.suptitle(title, fontsize=12)
    handles, labels = axes.get_legend_handles_labels()
    meaning = "mean ± one standard deviation over seeds; hollow: over the finite seeds only"
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, title=meaning)


def _bias(row: Row, name: str, truth: Mapping[str, float]) -> float:
    """recovered / true − 1 [%]."""
    value = None if row.theta is None else row.theta[name]
    return math.inf if value is None else 100 * (value / truth[name] - 1)


def _unit(name: str) -> str:
    return "N/(rad/s)²" if name == "k" else "kg m²"
