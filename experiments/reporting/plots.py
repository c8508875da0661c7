"""The style of all figures, their legend and files, and panels of test errors: a dot per seed, a bar per mean."""

import io
import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import PIL.Image
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogFormatterMathtext, LogLocator, MaxNLocator, NullFormatter

from experiments.reporting import names
from hybrid_jax.io.files import write_atomic

STYLE: dict[Any, Any] = dict(mpl.rc_params_from_file(Path(__file__).with_name("style.mplstyle"), False, False))
WIDTH = 4.2  # inches, of every figure: its letters are of 9 pixels on a phone of 400
DPI = 200
NAME, TITLE, LEGEND = 24, 56, 78  # letters: of a line of a name, of a title, and of a legend, with its handles
SHADES = 160  # colours of a picture, with their shades at edges
# Okabe and Ito's palette, which the colour-blind can tell apart.
COLOURS = {
    names.HYBRID: "#0072B2",
    names.NO_PHYSICS: "#D55E00",
    names.PHYSICS_ONLY: "#009E73",
    names.CONSTANT_DISTURBANCE: "#CC79A7",
}
# The same colours by what was done to a model, where a figure compares that.
METHODS = {
    "adapted": COLOURS[names.CONSTANT_DISTURBANCE],
    "fine-tuned": COLOURS[names.HYBRID],
    "physics": COLOURS[names.PHYSICS_ONLY],
    "not adapted": "0.45",
}
OTHERS = "0.4"  # the colour of models that no figure of the paper shows
DRAWABLE = 1e30  # a number beyond it overflows inside matplotlib and is drawn like one that is not finite
LARGEST_RATIO = 100.0  # an axis of errors ends at this many times the smallest mean; errors beyond are marked there
PADDING = 1.15  # factor of room at either end of an axis of errors
SMALL = 1e-4  # an axis that begins below it has powers of ten
LONG_NUMBER = 0.05  # numbers up to this need room on an axis
MOST_DECADES = 7  # with a tick of their own on a log axis
HALF_LINE = 0.3  # half the height of a line in a panel: of a mean's bar, and of the band of its seeds
FLOOR = "no model can do better"  # the label of the attainable error


class Line(NamedTuple):
    name: str
    errors: np.ndarray  # of each seed, not finite where it failed
    colour: str
    marked: str = ""  # legend label of a vertical line through the mean


def colour(model: str) -> str:
    return COLOURS.get(model, OTHERS)


def subplots(height: float, rows: int, columns: int, **options: Any) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def save_figures(out: Path, figures: Mapping[str, tuple[Figure, str]]) -> dict[str, str]:
    """Write figures, given with captions by name, as reproducible bytes in few colours; return the captions by file."""
    for name, (figure, _) in figures.items():
        drawn, content = io.BytesIO(), io.BytesIO()
        with mpl.rc_context(STYLE):
            figure.savefig(drawn, format="png", dpi=DPI)
        picture = PIL.Image.open(drawn).convert("RGB").quantize(SHADES, dither=PIL.Image.Dither.NONE)
        picture.save(content, "png", optimize=True)
        write_atomic(out / f"{name}.png", content.getvalue())
    return {f"{name}.png": caption for name, (_, caption) in figures.items()}


def legend_below(
    figure: Figure, title: str = "", meaning: str = "", columns: int = 3, entries: Mapping[str, Artist] | None = None
) -> Figure:
    """Draw a title above all panels, and below them one legend of all labels after `entries`, headed `meaning`."""
    shown = dict(entries or {})
    for axes in figure.axes:
        shown |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    return legend_of(shown, figure, title, meaning, columns)


def legend_of(entries: Mapping[str, Artist], figure: Figure, title: str, meaning: str, columns: int = 3) -> Figure:
    """Draw a title, and a legend of these entries alone, in fewer columns if their words need the room."""
    words = [_even(label, LEGEND // min(len(entries), columns, 2) - 8) for label in entries]
    longest = max((len(line) for lines in words for line in lines), default=1)
    columns = max(1, min(columns, LEGEND // (longest + 8)))
    about = {"loc": "outside lower center", "ncols": columns, "title": wrapped(meaning, TITLE) or None}
    figure.legend(entries.values(), [typeset("\n".join(lines)) for lines in words], **about)
    return titled(figure, title)


def titled(figure: Figure, title: str) -> Figure:
    if title:
        figure.suptitle(wrapped(title, TITLE))
    return figure


def error_panel(axes: Axes, lines: Sequence[Line], title: str, floor: float = 0.0) -> None:
    """Draw the lines, the first on top, and the attainable error (`floor`), if it is not 0."""
    limits = _limits([line.errors for line in lines], floor)
    axes.set(xscale="log", xlim=limits, title=title)
    axes.set_xlabel("mean squared error, state in SI units\n(log scale; lower is better)")
    name_lines(axes, [line.name for line in lines])
    tick_errors(axes.xaxis, *limits, room=2.2)
    for y, line in enumerate(lines):
        mean = _draw_line(axes, y, line.errors, line.colour, limits)
        if line.marked and limits[0] < mean < limits[1]:
            axes.axvline(mean, color=line.colour, linestyle=":", linewidth=1, label=line.marked)
    if limits[0] < floor < limits[1]:
        axes.axvline(floor, color="0.4", linestyle="-.", label=FLOOR)


def error_legend(figure: Figure, title: str, failed: bool) -> Figure:
    """Draw title and legend of error panels; `failed`: whether a mean omits an error that is not finite."""
    bar = {"color": "0.3", "marker": "|", "markersize": 12, "markeredgewidth": 2.2, "linestyle": ""}
    entries = {
        "a run": Line2D([], [], color="0.3", alpha=0.55, marker="o", markersize=4, linestyle=""),
        "mean over runs (dashed: over the finite ones)" if failed else "mean over runs": Line2D([], [], **bar),
    }
    return legend_below(figure, title, columns=2, entries=entries)


def dots(axes: Axes, lines: Sequence[Line], largest: float = math.inf) -> None:
    """Draw a dot for each run and a bar for the median, the first line on top; numbers above `largest` as ▷ there."""
    for y, line in enumerate(lines):
        place = y + np.linspace(-HALF_LINE, HALF_LINE, len(line.errors) + 2)[1:-1]
        for marker, drawn in (("o", line.errors <= largest), (">", line.errors > largest)):
            shown = np.minimum(line.errors[drawn], largest)
            axes.plot(shown, place[drawn], marker, color=line.colour, alpha=0.55, markersize=3.5, markeredgewidth=0)
        middle = min(float(np.median(line.errors)), largest)
        axes.plot([middle] * 2, [y - HALF_LINE, y + HALF_LINE], color=line.colour, linewidth=2)
    axes.set_xscale("log")
    name_lines(axes, [line.name for line in lines])
    tick_errors(axes.xaxis, *axes.get_xlim())


def name_lines(axes: Axes, names: Sequence[str]) -> None:
    """Label a line for each name, the first on top, at y = 0, 1, …"""
    axes.set(ylim=(len(names) - 0.4, -0.6))
    axes.set_yticks(range(len(names)), [wrapped(name, NAME) for name in names])


def typeset(text: str) -> str:
    """Write the symbols of a label as mathematics."""
    return re.sub(r"[θfp]_[pdxy]", lambda found: f"${found[0].replace('θ', chr(92) + 'theta')}$", text)


def wrapped(text: str, letters: int) -> str:
    """Break a label into even lines of at most so many letters, and write its symbols as mathematics."""
    return typeset("\n".join(_even(text, letters)))


def _even(text: str, letters: int) -> list[str]:
    def wrap(width: int) -> list[str]:
        return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)

    return next(lines for width in range(1, letters + 1) if len(lines := wrap(width)) <= len(wrap(letters)))


def note(axes: Axes, words: str, at: tuple[float, float], offset: tuple[float, float], **style: Any) -> None:
    """Draw small words beside a point, also outside the axes, on white; the offset is in points."""
    style = {"fontsize": 7, "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 0.4}} | style
    axes.annotate(words, at, offset, textcoords="offset points", annotation_clip=False, **style)


def tick_errors(axis: Axis, low: float, high: float, room: float = 0.0) -> None:
    """Set ticks of a log axis: decades, of at most `room` decades 1, 2 and 5 as well, of a short one round steps."""
    decades = math.log10(high / low)
    room = room or (2.2 if low > LONG_NUMBER else 1.5)
    subs = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if decades < 0.8 else (1.0, 2.0, 5.0) if decades < room else (1.0,)
    axis.set_major_locator(MaxNLocator(3) if decades < 0.5 else LogLocator(subs=subs, numticks=MOST_DECADES))
    powers = decades > 2 and low < SMALL
    axis.set_major_formatter(LogFormatterMathtext() if powers else FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _limits(errors: Iterable[np.ndarray], floor: float) -> tuple[float, float]:
    """Return limits around all errors within LARGEST_RATIO of the smallest mean, so that failed runs do not matter."""
    drawn = [values[(values > 1 / DRAWABLE) & (values < DRAWABLE)] for values in errors]
    means = [values.mean() for values in drawn if len(values)]
    if not means:
        return 0.1, 10.0
    near = np.concatenate([*drawn, [floor]])
    near = near[(near >= min(means) / LARGEST_RATIO) & (near <= min(means) * LARGEST_RATIO)]
    return near.min() / PADDING, near.max() * PADDING


def _draw_line(axes: Axes, y: int, values: np.ndarray, tint: str, limits: tuple[float, float]) -> float:
    """Draw a dot for each seed and a bar for the mean of the finite ones, which is returned; mark errors outside."""
    low, high = limits
    finite = values < DRAWABLE
    near = finite & (values >= low) & (values <= high)
    # Spread over the line's height, or seeds of one error would hide each other.
    heights = y + np.linspace(-HALF_LINE, HALF_LINE, len(values) + 2)[1:-1]
    axes.plot(values[near], heights[near], "o", color=tint, alpha=0.55, markersize=4, markeredgewidth=0)
    mean = float(values[finite].mean()) if finite.any() else math.nan
    if low <= mean <= high:
        style = {"linewidth": 2.2, "linestyle": "-" if finite.all() else (0, (1.2, 0.6))}
        axes.plot([mean] * 2, [y - HALF_LINE, y + HALF_LINE], color=tint, **style)
    above, below, failed = (int(np.sum(which)) for which in (finite & (values > high), values < low, ~finite))
    shown = f"{mean:.0f}" if 100 <= mean < 10_000 else f"{mean:.2g}"
    words = [f"{above} of {len(values)} beyond, mean {shown}"] if above else []
    words += [f"{failed} of {len(values)} not finite"] if failed else []
    marks = [("x" if failed == len(values) else ">", high, ";\n".join(words))] if words else []
    marks += [("<", low, f"{below} of {len(values)} below")] if below else []
    for marker, x, text in marks:
        axes.plot(x, y, marker, color=tint, markersize=7, clip_on=False, zorder=5)
        # Inside the panel, left of the seeds or, at its left edge, right of the marker: outside they would narrow it.
        at, offset, ha = (x, 8, "left") if marker == "<" else (min(values[near], default=high), -8, "right")
        note(axes, text, (at, y), (offset, 0), va="center", ha=ha, fontsize=7, color=tint)
    return mean
