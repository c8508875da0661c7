"""Test errors of several ways of doing a thing on one axis: a dot for each seed, a bar for their mean."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from experiments.paper.figures import DRAWABLE

REACH = 100.0  # the axis ends at this many times the smallest mean; what lies beyond is marked at its edge
MARGIN = 1.15  # factor of room at either end of the axis
LONG = 0.05  # numbers up to this are long, such as 0.05
HALF = 0.3  # of the height of a line of the figure: a mean's bar, and the band over which its seeds are spread

_Limits = tuple[float, float]


class Line(NamedTuple):
    """One way: its name, the error of each seed, not finite where it failed, and a colour.

    `marked`, if it is not empty, is what the legend calls a vertical line through the mean.
    """

    name: str
    errors: np.ndarray
    colour: str
    marked: str = ""


def draw_panel(axes: Axes, lines: Sequence[Line], title: str, floor: float = 0.0) -> None:
    """A line of the panel for each way, the first on top.

    Args:
        floor: an error that no model at hand can get below; 0 if there is none.
    """
    limits = _limits([line.errors for line in lines], floor)
    axes.set(xscale="log", xlim=limits, ylim=(len(lines) - 0.4, -0.6), title=title)
    axes.set_xlabel("test error $L^T_{MSE}$  (state in SI units, squared; log scale)")
    axes.set_yticks(range(len(lines)), [line.name for line in lines])
    tick_errors(axes.xaxis, *limits)
    for y, line in enumerate(lines):
        mean = _draw_line(axes, y, line.errors, line.colour, limits)
        if line.marked and limits[0] < mean < limits[1]:
            axes.axvline(mean, color=line.colour, linestyle=":", linewidth=1, label=line.marked)
    if limits[0] < floor < limits[1]:
        axes.axvline(floor, color="0.4", linestyle="-.", label="floor: what no model here can see")


def add_legend(figure: Figure, failed: bool) -> None:
    """Below all panels: what dots and bars are, and what the panels have labelled.

    Args:
        failed: whether an error that is not finite is left out of a mean.
    """
    bar = {"color": "0.3", "marker": "|", "markersize": 12, "markeredgewidth": 2.2, "linestyle": ""}
    entries = {
        "a seed": Line2D([], [], color="0.3", alpha=0.55, marker="o", markersize=4, linestyle=""),
        "mean over seeds (broken: over the finite ones)" if failed else "mean over seeds": Line2D([], [], **bar),
    }
    for axes in figure.axes:
        entries |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=2)


def tick_errors(axis: Axis, low: float, high: float) -> None:
    """Numbers at 1, 2, 5 of a decade; at more of it or at round steps where a log axis is shorter, at decades where it
    is longer.
    """
    decades = math.log10(high / low)
    room = 2.2 if low > LONG else 1.5  # decades
    subs = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if decades < 0.8 else (1.0, 2.0, 5.0) if decades < room else (1.0,)
    axis.set_major_locator(MaxNLocator(5) if decades < 0.5 else LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _limits(errors: Iterable[np.ndarray], floor: float) -> _Limits:
    """Around all errors within REACH of the smallest mean, so that one failed run does not flatten the rest."""
    drawn = [values[(values > 1 / DRAWABLE) & (values < DRAWABLE)] for values in errors]
    means = [values.mean() for values in drawn if len(values)]
    if not means:
        return 0.1, 10.0
    near = np.concatenate([*drawn, [floor]])
    near = near[(near >= min(means) / REACH) & (near <= min(means) * REACH)]
    return near.min() / MARGIN, near.max() * MARGIN


def _draw_line(axes: Axes, y: int, values: np.ndarray, tint: str, limits: _Limits) -> float:
    """A dot for each seed and a bar for the mean of the finite ones, which is returned; what is off is marked."""
    low, high = limits
    finite = values < DRAWABLE
    inside = finite & (values >= low) & (values <= high)
    # Spread over the line's height, or seeds of one error would hide each other.
    heights = y + np.linspace(-HALF, HALF, len(values) + 2)[1:-1]
    axes.plot(values[inside], heights[inside], "o", color=tint, alpha=0.55, markersize=4, markeredgewidth=0)
    mean = float(values[finite].mean()) if finite.any() else math.nan
    if low <= mean <= high:
        style = {"linewidth": 2.2, "linestyle": "-" if finite.all() else (0, (1.2, 0.6))}
        axes.plot([mean] * 2, [y - HALF, y + HALF], color=tint, **style)
    above, below, failed = (int(np.sum(which)) for which in (finite & (values > high), values < low, ~finite))
    shown = f"{mean:.0f}" if 100 <= mean < 10_000 else f"{mean:.2g}"
    words = [f"{above} of {len(values)} beyond, mean {shown}"] if above else []
    words += [f"{failed} of {len(values)} not finite"] if failed else []
    if words:
        _mark_edge(axes, "x" if failed == len(values) else ">", (high, y), ";\n".join(words), tint)
    if below:
        _mark_edge(axes, "<", (low, y), f"{below} of {len(values)} below", tint)
    return mean


def _mark_edge(axes: Axes, marker: str, at: tuple[float, float], words: str, tint: str) -> None:
    """The words stand right of the marker: outside the panel at its right edge, where they hide no seed."""
    axes.plot(*at, marker, color=tint, markersize=7, clip_on=False, zorder=5)
    style = {"va": "center", "fontsize": 8, "color": tint, "annotation_clip": False}
    axes.annotate(words, at, (8, 0), textcoords="offset points", **style)
