"""Figures of closed-loop flight: errors of all that flew, shares of the gap, promises, far from home, and paths."""

import math
from collections.abc import Iterable, Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.closed_loop.rows import DOMAINS, NAMES, REFERENCES, FlightRow, Flyer, cells
from experiments.closed_loop.tables import ORACLE, gaps
from experiments.paper.figures import COLOURS, STYLE
from experiments.reporting.error_panels import Line, add_legend, draw_panel, tick_errors

TINTS = {
    "nominal": "0.45",
    "physics": COLOURS["physics_only"],
    "hybrid": COLOURS["hybrid"],
    "no_physics": COLOURS["no_physics"],
    "safe": "#CC79A7",
    "nine": "#882255",
    "oracle": "black",
}
MARKERS = dict(zip(REFERENCES, "os^Dv*", strict=True))
SHARES = (-25.0, 125.0)  # %: what lies beyond is marked at the edge
KEPT = 0.1
COSTS = ("promised", "realised")
NEAREST = 0.01  # cm: where the model of a hovering vehicle is right, it does not move
LEAST = 1e-3  # of a cost, for a logarithmic axis
XLABEL = "position RMSE [cm]  (log scale)"


@mpl.rc_context(STYLE)
def errors(rows: Sequence[FlightRow], domain: str) -> Figure:
    """A panel for each reference, a line for each that flew, a dot for each seed.

    Raises:
        ValueError: no rows of this domain at home.
    """
    found = {cell[1]: group for cell, group in cells(rows).items() if cell[0] == domain and not cell[2]}
    if not found:
        raise ValueError(f"rows must not be empty: nothing was flown in {domain}")
    figure, panels = _grid(len(found), [flyer.name for group in found.values() for flyer in group])
    for axes, (reference, group) in zip(panels, sorted(found.items(), key=_place), strict=False):
        draw_panel(axes, [_line(flyer, group[flyer]) for flyer in group], REFERENCES[reference])
        axes.set_xlabel(XLABEL)
    figure.suptitle(
        f"{NAMES[domain].capitalize()}: how far from the reference each model flies (not finite: crashed"
        f"{floored(_nearest(found.values()), NEAREST, '; ')})",
        fontsize=12,
    )
    add_legend(figure, any(row.crashed for group in found.values() for flown in group.values() for row in flown))
    return figure


@mpl.rc_context(STYLE)
def ablation(rows: Sequence[FlightRow], domain: str) -> Figure:
    """A panel for each reference and distance, a line for each variant.

    Raises:
        ValueError: no rows of this domain.
    """
    found = {cell: group for cell, group in cells(rows).items() if cell[0] == domain}
    if not found:
        raise ValueError(f"rows must not be empty: nothing was flown in {domain}")
    figure, panels = _grid(len(found), [flyer.variant for group in found.values() for flyer in group])
    for axes, ((_, reference, away), group) in zip(panels, found.items(), strict=False):
        lines = [Line(f.variant, _centimetres(flown), TINTS[f.model]) for f, flown in group.items()]
        draw_panel(axes, lines, REFERENCES[reference] + (f", {away:g} m from home" if away else ""))
        axes.set_xlabel(XLABEL)
    figure.suptitle(
        f"{NAMES[domain].capitalize()}: what makes a network safe to fly (not finite: crashed"
        f"{floored(_nearest(found.values()), NEAREST, '; ')})",
        fontsize=12,
    )
    add_legend(figure, any(row.crashed for group in found.values() for flown in group.values() for row in flown))
    return figure


@mpl.rc_context(STYLE)
def far_from_home(rows: Sequence[FlightRow]) -> Figure:
    """At home and far away, each model that flew at both: a column for each reference, a row for each domain.

    Raises:
        ValueError: nothing was flown both at home and away from it.
    """
    found = cells(rows)
    both = (cell for cell in found if cell[2] and (*cell[:2], 0.0) in found)
    away = sorted(both, key=lambda cell: (DOMAINS.index(cell[0]), _place(cell[1:])))
    if not away:
        raise ValueError("rows must not be empty: nothing was flown both at home and away from it")
    domains, references = (list(dict.fromkeys(cell[i] for cell in away)) for i in (0, 1))
    height = 1.4 + len(domains) * (0.7 + 0.27 * max(len(found[cell]) for cell in away))
    figure = Figure(figsize=(3.6 * len(references) + 2, height), layout="constrained")
    panels = figure.subplots(len(domains), len(references), squeeze=False, sharey="row")
    for domain, reference, distance in away:
        axes = panels[domains.index(domain), references.index(reference)]
        _draw_away(axes, found[domain, reference, 0.0], found[domain, reference, distance])
        axes.set_title(f"{NAMES[domain].capitalize()}, {REFERENCES[reference]}")
    entries = {
        "at home": Line2D([], [], color="0.3", marker="o", linestyle="", markersize=5),
        f"{away[0][2]:g} m away": Line2D([], [], color="0.3", marker=">", linestyle="", markersize=7),
    }
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=2, title="mean over seeds")
    pairs = (_means(found[*cell[:2], 0.0], found[cell]) for cell in away)
    nearest = min(value for means in pairs for pair in means.values() for value in pair)
    words = floored(nearest, NEAREST, " (")
    figure.suptitle("The same flight at home and far from it" + (f"{words})" if words else ""), fontsize=12)
    return figure


@mpl.rc_context(STYLE)
def shares(rows: Sequence[FlightRow], domain: str) -> Figure:
    """The share of the gap to the true vehicle that each way of adapting closes, a panel for each reference.

    Raises:
        ValueError: no rows that could tell.
    """
    found = gaps(cells(rows), domain)
    references = [reference for reference in REFERENCES if any(reference in line for line in found.values())]
    if not references:
        raise ValueError(f"rows must hold a source model and the true vehicle in {domain}")
    figure, panels = _grid(len(references), [flyer.name for flyer in found], width=2.6)
    for axes, reference in zip(panels, references, strict=False):
        axes.set(xlim=SHARES, ylim=(len(found) - 0.4, -0.6))
        axes.set_title(REFERENCES[reference], pad=16)
        axes.set_xlabel("share of the gap closed [%]")
        axes.set_xticks([0, 50, 100])
        axes.set_yticks(range(len(found)), [flyer.name for flyer in found])
        for x, words in ((0.0, "source"), (100.0, "true vehicle")):
            axes.axvline(x, color="0.4", linestyle=":", linewidth=1)
            axes.text(x, -0.66, words, fontsize=7, color="0.4", ha="center", va="bottom")
        for y, (flyer, line) in enumerate(found.items()):
            _draw_share(axes, y, line.get(reference, (math.nan,) * 3), TINTS[flyer.model])
    figure.suptitle(
        f"{NAMES[domain].capitalize()}: share of the gap from source to true vehicle (bar: 95 %; hollow: no sure gap)",
        fontsize=12,
    )
    return figure


@mpl.rc_context(STYLE)
def promised(rows: Sequence[FlightRow], flyers: Sequence[Flyer]) -> Figure:
    """Realised against promised cost of plans, mean over seeds: a panel for each domain, a marker for each reference.

    Raises:
        ValueError: none of these flew.
    """
    found = {cell: group for cell, group in cells(rows).items() if not cell[2]}
    domains = [domain for domain in DOMAINS if any(cell[0] == domain for cell in found)]
    if not any(flyer in group for group in found.values() for flyer in flyers):
        raise ValueError("rows must hold one of the flyers: there is nothing to draw")
    figure = Figure(figsize=(4.4 * len(domains) + 2.2, 4.6), layout="constrained")
    panels = figure.subplots(1, len(domains), squeeze=False, sharex=True, sharey=True)[0]
    for axes, domain in zip(panels, domains, strict=True):
        _draw_promises(axes, {cell[1]: group for cell, group in found.items() if cell[0] == domain}, flyers)
        axes.set(title=NAMES[domain].capitalize(), xlabel="promised cost of a plan", ylabel="realised in the truth")
    who = [Line2D([], [], color=_shade(f), marker="o", linestyle="", label=f.name) for f in flyers]
    where = [
        Line2D([], [], color="0.5", marker=MARKERS[reference], linestyle="", label=REFERENCES[reference])
        for reference in REFERENCES
        if any(cell[1] == reference for cell in found)
    ]
    figure.legend(handles=[*who, *where], loc="outside right center")
    figure.suptitle(
        "What plans promise and what they cost, flown open loop for 1 s (grey: within 10 %; below 0.001 drawn there)",
        fontsize=12,
    )
    return figure


def floored(nearest: float, floor: float, before: str) -> str:
    """Words for a title after `before`: that less than the floor [cm] is drawn there; none if nothing [cm] is less."""
    return f"{before}below {floor:g} cm drawn there" if nearest < floor else ""


def _grid(count: int, names: Sequence[str], width: float = 3.2) -> tuple[Figure, list[Axes]]:
    """Panels for as many references, with room for a line of each of these names, which may stand there twice."""
    columns = 2 if count == 4 else min(count, 3)
    rows, room = -(-count // columns), 0.085 * max(map(len, names))
    size = width * columns + room, rows * (1.0 + 0.25 * len(set(names))) + 0.9
    figure = Figure(figsize=size, layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for i, axes in enumerate(panels):
        axes.tick_params(labelleft=i % columns == 0)  # the lines are those of the first column
        axes.set_visible(i < count)
    return figure, panels


def _place(item) -> int:
    return list(REFERENCES).index(item[0])


def _centimetres(rows: Sequence[FlightRow]) -> np.ndarray:
    """Position RMSE; what is nearer than NEAREST is drawn there."""
    return np.array([max(100 * row.error, NEAREST) for row in rows])


def _nearest(groups: Iterable[Mapping[Flyer, list[FlightRow]]]) -> float:
    """The least position RMSE [cm]."""
    return min(100 * row.error for group in groups for rows in group.values() for row in rows)


def _line(flyer: Flyer, rows: Sequence[FlightRow]) -> Line:
    marked = "the true vehicle as its own model" if flyer == ORACLE else ""
    return Line(flyer.name, _centimetres(rows), TINTS[flyer.model], marked)


def _means(
    home: Mapping[Flyer, list[FlightRow]], away: Mapping[Flyer, list[FlightRow]]
) -> dict[Flyer, tuple[float, float]]:
    """The mean position RMSE [cm] here and there of who flew there."""
    return {who: (_mean(home[who]), _mean(away[who])) for who in away}


def _mean(rows: Sequence[FlightRow]) -> float:
    return 100 * float(np.mean([row.error for row in rows]))


def _draw_away(axes: Axes, home: Mapping[Flyer, list[FlightRow]], away: Mapping[Flyer, list[FlightRow]]) -> None:
    means = _means(home, away)
    finite = [max(value, NEAREST) for pair in means.values() for value in pair if math.isfinite(value)] or [1.0]
    axes.set(xscale="log", xlim=(min(finite) / 1.4, max(finite) * 1.8), ylim=(len(away) - 0.4, -0.6), xlabel=XLABEL)
    tick_errors(axes.xaxis, *axes.get_xlim())
    axes.set_yticks(range(len(away)), [flyer.name for flyer in away])
    for y, (flyer, (here, there)) in enumerate(means.items()):
        edge = axes.get_xlim()[1]
        start, end = max(here, NEAREST), min(max(there, NEAREST), edge)
        axes.plot([start, end], [y, y], color=TINTS[flyer.model], linewidth=1)
        axes.plot(start, y, "o", color=TINTS[flyer.model], markersize=5)
        crashed = sum(row.crashed for row in away[flyer])
        number = f"{there:.2g}" if there >= NEAREST else f"{there:.2f}"
        words = f"{crashed} of {len(away[flyer])} crash" if crashed else number
        axes.plot(end, y, "x" if crashed else ">", color=TINTS[flyer.model], markersize=7, clip_on=False)
        style = {
            "va": "bottom" if crashed else "center",
            "fontsize": 7,
            "ha": "right" if crashed else "left",
            "annotation_clip": False,
        }
        axes.annotate(
            words,
            (end, y),
            (-8 if crashed else 7, 4 if crashed else 0),
            textcoords="offset points",
            **style,
        )


def _draw_share(axes: Axes, y: int, share, tint: str) -> None:
    value, low, high = (100 * number for number in share)
    if math.isnan(value):
        axes.text(50.0, y, "no gap", fontsize=8, color="0.4", ha="center", va="center")
        return
    if not math.isnan(low):
        axes.plot(np.clip([low, high], *SHARES), [y, y], color=tint, linewidth=2)
    inside = SHARES[0] <= value <= SHARES[1]
    marker = "o" if inside else "<" if value < SHARES[0] else ">"
    filled = "white" if math.isnan(low) else tint  # hollow: the seeds are not sure that there is a gap
    axes.plot(np.clip(value, *SHARES), y, marker, color=tint, markersize=5, clip_on=False, markerfacecolor=filled)
    if not inside:
        left = value < SHARES[0]
        at, align = ((6, 3), "left") if left else ((-6, 3), "right")
        axes.annotate(f"{value:.0f}", (np.clip(value, *SHARES), y), at, textcoords="offset points", fontsize=7,
                      va="bottom", ha=align)  # fmt: skip


def _draw_promises(axes: Axes, groups: Mapping[str, Mapping[Flyer, list[FlightRow]]], flyers: Sequence[Flyer]) -> None:
    axes.set(xscale="log", yscale="log")
    drawn = [LEAST]
    for reference, group in groups.items():
        for flyer in flyers:
            sound = [row for row in group.get(flyer, []) if row.promised and row.realised and not row.crashed]
            if sound:
                means = [max(float(np.mean([getattr(row, name) for row in sound])), LEAST) for name in COSTS]
                axes.plot(*means, MARKERS[reference], color=_shade(flyer), markersize=6, alpha=0.8)
                drawn += means
    ends = np.array([min(drawn[1:], default=LEAST) / 2, max(drawn) * 2])
    axes.fill_between(ends, (1 - KEPT) * ends, (1 + KEPT) * ends, color="0.85", zorder=0)
    axes.plot(ends, ends, color="0.6", linewidth=1, zorder=0)


def _shade(flyer: Flyer) -> str:
    """The model's colour; what was not adapted is paler."""
    learned = flyer.model in ("hybrid", "safe")
    return (
        {"hybrid": "#7FC4EA", "safe": "#E9C6D9"}[flyer.model] if learned and not flyer.n_train else TINTS[flyer.model]
    )
