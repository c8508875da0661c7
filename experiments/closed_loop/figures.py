"""Figures of closed-loop flight: errors, shares of the gap, open-loop costs, and flights away from home."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.closed_loop.rows import DOMAINS, ERROR, ORACLE, REFERENCES, Agent, by_agent, centimetres
from experiments.closed_loop.tables import gaps
from experiments.reporting.plots import COLOURS, STYLE, Line, error_legend, error_panel, legend_below, tick_errors
from experiments.reporting.results import Results
from experiments.reporting.stats import Interval

COLOURS_OF = {
    "nominal": "0.45",
    "physics": COLOURS["physics_only"],
    "hybrid": COLOURS["hybrid"],
    "no_physics": COLOURS["no_physics"],
    "invariant": "#CC79A7",
    "least_squares": "#882255",
    "oracle": "black",
}
PALE = {"hybrid": "#7FC4EA", "invariant": "#E9C6D9"}  # source models beside adapted ones
MARKERS = dict(zip(REFERENCES, "os^Dv*", strict=True))
SHARES = (-25.0, 125.0)  # %: shares outside are marked at the edge
COST_TOLERANCE = 0.1
SMALLEST_ERROR = 0.01  # cm: smaller errors are drawn here; with the true model a hovering vehicle does not move
SMALLEST_COST = 1e-3
XLABEL = "position RMSE [cm]  (log scale)"


def errors(rows: Results, domain: str) -> Figure:
    """A panel per reference, a line per agent, a dot per seed.

    Raises:
        ValueError: no rows of this domain at home.
    """
    found = rows.where(domain=domain, distance=0.0).sort(reference=list(REFERENCES)).group("reference")
    panels = {REFERENCES[reference]: group for reference, group in found.items()}
    return _error_panels(panels, lambda agent: agent.name, domain, "position error of each model")


def ablation(rows: Results, domain: str) -> Figure:
    """A panel per reference and distance, a line per variant.

    Raises:
        ValueError: no rows of this domain.
    """
    found = rows.where(domain=domain).group("reference", "distance")
    panels = {REFERENCES[name] + (f", {d:g} m from home" if d else ""): group for (name, d), group in found.items()}
    return _error_panels(panels, lambda agent: agent.variant, domain, "ablation of the invariant residual")


@mpl.rc_context(STYLE)
def away_from_home(rows: Results) -> Figure:
    """Each model at home and away: a column per reference, a row per domain.

    Raises:
        ValueError: nothing was flown both at home and away from it.
    """
    order = {"domain": list(DOMAINS), "reference": list(REFERENCES)}
    found = rows.sort(**order).group("domain", "reference", "distance")
    away = [cell for cell in found if cell[2] and (*cell[:2], 0.0) in found]
    if not away:
        raise ValueError("rows must not be empty: nothing was flown both at home and away from it")
    domains, references = (list(dict.fromkeys(cell[i] for cell in away)) for i in (0, 1))
    height = 1.4 + len(domains) * (0.7 + 0.27 * max(len(by_agent(found[cell])) for cell in away))
    figure = Figure(figsize=(3.6 * len(references) + 2, height), layout="constrained")
    panels = figure.subplots(len(domains), len(references), squeeze=False, sharey="row")
    smallest = math.inf
    for domain, reference, distance in away:
        axes = panels[domains.index(domain), references.index(reference)]
        axes.set_title(f"{DOMAINS[domain].capitalize()}, {REFERENCES[reference]}")
        home, there = (by_agent(found[domain, reference, d]) for d in (0.0, distance))
        smallest = min(smallest, _draw_away(axes, home, there))
    style: Any = {"color": "0.3", "linestyle": ""}
    entries = {
        "at home": Line2D([], [], marker="o", markersize=5, **style),
        f"{away[0][2]:g} m away": Line2D([], [], marker=">", markersize=7, **style),
    }
    title = "The same flights at home and away from it" + floor_note(smallest, SMALLEST_ERROR, " (", ")")
    return legend_below(figure, title, "mean over seeds", 2, entries)


@mpl.rc_context(STYLE)
def shares(rows: Results, domain: str) -> Figure:
    """The share of the gap to the true vehicle that each way to adapt closes, a panel per reference.

    Raises:
        ValueError: rows without a source model or the true vehicle.
    """
    found = gaps(rows, domain)
    names = [name for name in REFERENCES if any(name in line for line in found.values())]
    if not names:
        raise ValueError(f"rows must hold a source model and the true vehicle in {domain}")
    figure, panels = _grid(len(names), [agent.name for agent in found], width=2.6)
    for axes, name in zip(panels, names, strict=False):
        axes.set(xlim=SHARES, ylim=(len(found) - 0.4, -0.6), xlabel="share of the gap closed [%]")
        axes.set_title(REFERENCES[name], pad=16)
        axes.set_xticks([0, 50, 100])
        axes.set_yticks(range(len(found)), [agent.name for agent in found])
        for x, words in ((0.0, "source"), (100.0, "true vehicle")):
            axes.axvline(x, color="0.4", linestyle=":", linewidth=1)
            axes.text(x, -0.66, words, fontsize=7, color="0.4", ha="center", va="bottom")
        for y, (agent, line) in enumerate(found.items()):
            _draw_share(axes, y, line.get(name, Interval(*[math.nan] * 3)), COLOURS_OF[agent.model])
    what = "share of the gap from source to true vehicle (bar: 95 %; hollow: gap not significant)"
    figure.suptitle(f"{DOMAINS[domain].capitalize()}: {what}", fontsize=12)
    return figure


@mpl.rc_context(STYLE)
def open_loop_costs(rows: Results, agents: Sequence[Agent]) -> Figure:
    """Actual against predicted cost of plans, mean over seeds: a panel per domain, a marker per reference.

    Raises:
        ValueError: no rows of these agents.
    """
    found = {domain: rows.where(domain=domain, distance=0.0) for domain in DOMAINS if domain in rows["domain"]}
    if not any(agent in by_agent(group) for group in found.values() for agent in agents):
        raise ValueError("rows must hold one of the agents: there is nothing to draw")
    figure = Figure(figsize=(4.4 * len(found) + 2.2, 4.6), layout="constrained")
    panels = figure.subplots(1, len(found), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (domain, group) in zip(panels, found.items(), strict=True):
        _draw_costs(axes, group, agents)
        axes.set(title=DOMAINS[domain].capitalize(), xlabel="predicted cost of a plan", ylabel="actual cost, open loop")
    handles = [Line2D([], [], color=_shade(agent), marker="o", linestyle="", label=agent.name) for agent in agents]
    handles += [
        Line2D([], [], color="0.5", marker=MARKERS[name], linestyle="", label=label)
        for name, label in REFERENCES.items()
        if any(name in group["reference"] for group in found.values())
    ]
    figure.legend(handles=handles, loc="outside right center")
    title = "Predicted and actual cost of plans, open loop for 1 s (grey: within 10 %; below 0.001 drawn there)"
    figure.suptitle(title, fontsize=12)
    return figure


def floor_note(smallest: float, floor: float, before: str, after: str = "") -> str:
    """A remark for a title, if any error [cm] is below the floor at which it is drawn."""
    return f"{before}below {floor:g} cm drawn there{after}" if smallest < floor else ""


@mpl.rc_context(STYLE)
def _error_panels(panels: Mapping[str, Results], label: Callable[[Agent], str], domain: str, what: str) -> Figure:
    """A panel of each of these groups by title, a line per agent."""
    if not panels:
        raise ValueError(f"rows must not be empty: nothing was flown in {domain}")
    groups = [by_agent(group) for group in panels.values()]
    figure, grid = _grid(len(panels), [label(agent) for group in groups for agent in group])
    for axes, title, group in zip(grid, panels, groups, strict=False):
        lines = [_line(label(agent), agent, rows) for agent, rows in group.items()]
        error_panel(axes, lines, title)
        axes.set_xlabel(XLABEL)
    all_errors = np.concatenate([100 * group.numbers(ERROR) for group in panels.values()])
    note = floor_note(all_errors.min(), SMALLEST_ERROR, "; ")
    title = f"{DOMAINS[domain].capitalize()}: {what} (not finite: crashed{note})"
    return error_legend(figure, title, any(any(group["crashed"]) for group in panels.values()))


def _line(label: str, agent: Agent, rows: Results) -> Line:
    marked = "the true vehicle as its own model" if agent == ORACLE else ""
    return Line(label, np.maximum(100 * rows.numbers(ERROR), SMALLEST_ERROR), COLOURS_OF[agent.model], marked)


def _grid(count: int, labels: Sequence[str], width: float = 3.2) -> tuple[Figure, list[Axes]]:
    """So many panels, with room for the labels of lines in the first column."""
    columns = 2 if count == 4 else min(count, 3)
    rows, room = -(-count // columns), 0.085 * max(map(len, labels))
    size = width * columns + room, rows * (1.0 + 0.25 * len(set(labels))) + 0.9
    figure = Figure(figsize=size, layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for i, axes in enumerate(panels):
        axes.tick_params(labelleft=i % columns == 0)
        axes.set_visible(i < count)
    return figure, panels


def _draw_away(axes: Axes, home: Mapping[Agent, Results], away: Mapping[Agent, Results]) -> float:
    """Draw mean errors at home and away, joined by a line; returns the smallest [cm]."""
    means = {agent: (centimetres(home[agent]), centimetres(rows)) for agent, rows in away.items()}
    values = [value for pair in means.values() for value in pair]
    finite = [max(value, SMALLEST_ERROR) for value in values if math.isfinite(value)] or [1.0]
    axes.set(xscale="log", xlim=(min(finite) / 1.4, max(finite) * 1.8), ylim=(len(away) - 0.4, -0.6), xlabel=XLABEL)
    tick_errors(axes.xaxis, *axes.get_xlim())
    axes.set_yticks(range(len(away)), [agent.name for agent in away])
    edge = axes.get_xlim()[1]
    for y, (agent, (here, there)) in enumerate(means.items()):
        start, end = max(here, SMALLEST_ERROR), min(max(there, SMALLEST_ERROR), edge)
        colour, crashed = COLOURS_OF[agent.model], sum(away[agent]["crashed"])
        axes.plot([start, end], [y, y], color=colour, linewidth=1)
        axes.plot(start, y, "o", color=colour, markersize=5)
        axes.plot(end, y, "x" if crashed else ">", color=colour, markersize=7, clip_on=False)
        number = f"{there:.2g}" if there >= SMALLEST_ERROR else f"{there:.2f}"
        words = f"{crashed} of {len(away[agent])} crash" if crashed else number
        side: Any = {"va": "bottom", "ha": "right"} if crashed else {"va": "center", "ha": "left"}
        offset = (-8, 4) if crashed else (7, 0)
        at: Any = {"textcoords": "offset points", "fontsize": 7, "annotation_clip": False}
        axes.annotate(words, (end, y), offset, **at, **side)
    return min(values)


def _draw_share(axes: Axes, y: int, share: Interval, colour: str) -> None:
    value, low, high = (100 * number for number in share)
    if math.isnan(value):
        axes.text(50.0, y, "no gap", fontsize=8, color="0.4", ha="center", va="center")
        return
    if not math.isnan(low):
        axes.plot(np.clip([low, high], *SHARES), [y, y], color=colour, linewidth=2)
    x = float(np.clip(value, *SHARES))
    marker = "o" if x == value else "<" if value < x else ">"
    filled = "white" if math.isnan(low) else colour
    axes.plot(x, y, marker, color=colour, markersize=5, clip_on=False, markerfacecolor=filled)
    if x != value:
        offset, align = ((6, 3), "left") if value < x else ((-6, 3), "right")
        at: Any = {"textcoords": "offset points", "fontsize": 7}
        axes.annotate(f"{value:.0f}", (x, y), offset, va="bottom", ha=align, **at)


def _draw_costs(axes: Axes, rows: Results, agents: Sequence[Agent]) -> None:
    axes.set(xscale="log", yscale="log")
    drawn = []
    for reference, group in rows.group("reference").items():
        flown = by_agent(group.where(lambda row: bool(row["promised"] and row["realised"]), crashed=False))
        for agent in filter(flown.__contains__, agents):
            means = [max(flown[agent].spread(column).mean, SMALLEST_COST) for column in ("promised", "realised")]
            axes.plot(*means, MARKERS[reference], color=_shade(agent), markersize=6, alpha=0.8)
            drawn += means
    ends = np.array([min(drawn, default=SMALLEST_COST) / 2, max(drawn, default=SMALLEST_COST) * 2])
    axes.fill_between(ends, (1 - COST_TOLERANCE) * ends, (1 + COST_TOLERANCE) * ends, color="0.85", zorder=0)
    axes.plot(ends, ends, color="0.6", linewidth=1, zorder=0)


def _shade(agent: Agent) -> str:
    return COLOURS_OF[agent.model] if agent.n_train else PALE.get(agent.model, COLOURS_OF[agent.model])
