"""Figures of closed-loop flight: errors, before and after adaptation, open-loop costs, flights away from home.

Each raises ValueError if the rows hold nothing to draw.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.closed_loop.claims import COST_TOLERANCE
from experiments.closed_loop.results import DOMAINS, ERROR, ORACLE, SOURCES, Agent, away, by_agent, gaps
from experiments.flying.scenario import REFERENCES
from experiments.reporting import plots
from experiments.reporting.plots import COLOURS, STYLE, Line, legend_below, name_lines, note, subplots
from experiments.reporting.results import Results

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
SMALLEST_ERROR = 0.01  # cm: smaller errors are drawn here; with the true model a hovering vehicle does not move
SMALLEST_COST = 1e-3
XLABEL = "position RMSE [cm]  (log scale)"


@mpl.rc_context(STYLE)
def errors(rows: Results, domain: str, ablation: bool = False) -> Figure:
    """A row of panels per question, a column per reference at home; a line per agent, a dot per seed.

    Of an ablation there is one row, also away, and a line per variant.
    """
    rows = rows.where(domain=domain)
    if not ablation:
        rows = rows.where(distance=0.0).sort(reference=list(REFERENCES))
    label = attrgetter("variant" if ablation else "name")
    places = {place: by_agent(group) for place, group in rows.group("reference", "distance").items()}
    if not places:
        raise ValueError(f"rows must not be empty: nothing was flown in {domain}")
    agents = list(dict.fromkeys(agent for group in places.values() for agent in group))
    asked = {"": agents} if ablation else questions(agents)
    counts = [len(group) for group in asked.values()]
    size = (
        1.25 * len(places) + 0.075 * max(len(label(agent)) for agent in agents),
        1.0 + sum(0.55 + 0.2 * n for n in counts),
    )
    figure, panels = subplots(size, len(asked), len(places), height_ratios=counts)
    for line, (question, group) in zip(panels, asked.items(), strict=True):
        for axes, ((reference, distance), found) in zip(line, places.items(), strict=True):
            _draw_errors(axes, found, group, label)
            axes.tick_params(labelleft=axes is line[0], labelbottom=line[0] is panels[-1, 0])
            if line[0] is panels[0, 0]:
                axes.set_title(REFERENCES[reference] + away(distance))
        line[0].text(-0.02, 1.02, question, transform=line[0].transAxes, fontweight="bold", ha="right", va="bottom")
    panels[-1, len(places) // 2].set_xlabel(XLABEL)
    note = floor_note(100 * rows.numbers(ERROR).min(), SMALLEST_ERROR, "; ")
    what = "ablation of the invariant residual" if ablation else "position error of each model"
    title = f"{DOMAINS[domain].capitalize()}: {what} (not finite: crashed{note})"
    return plots.error_legend(figure, title, any(rows["crashed"]))


def questions(agents: Sequence[Agent]) -> dict[str, list[Agent]]:
    """The agents that answer each question, each question with some; the true vehicle is a line in all panels."""
    few = min((agent.n_train for agent in agents if agent.n_train), default=0)
    networks = ("hybrid", "no_physics")
    found = {
        "Does more flight help?": [a for a in agents if a.model in networks and not a.observer],
        "Which model?": [a for a in agents if a.model not in ("oracle", *networks) and not a.observer],
        "With an observer?": [a for a in agents if a.observer],
    }
    same = [a for a in agents if a.model == "hybrid" and a.n_train == few and not a.observer]
    found["Which model?"] = [*same, *found["Which model?"]]
    return {question: group for question, group in found.items() if group}


def _draw_errors(
    axes: Axes, found: Mapping[Agent, Results], group: Sequence[Agent], label: Callable[[Agent], str]
) -> None:
    def line(agent: Agent) -> Line:
        errors = 100 * found[agent].numbers(ERROR) if agent in found else np.empty(0)
        return Line(label(agent), np.maximum(errors, SMALLEST_ERROR), COLOURS_OF[agent.model])

    plots.error_panel(axes, [line(agent) for agent in group], "", beside=[line(agent) for agent in found])
    axes.set_xlabel("")
    if ORACLE in found and ORACLE not in group:
        best = max(100 * found[ORACLE].spread(ERROR).mean, SMALLEST_ERROR)
        axes.axvline(best, color="black", linestyle=":", linewidth=1, label="the true vehicle as its own model")


@mpl.rc_context(STYLE)
def away_from_home(rows: Results) -> Figure:
    """Each model at home and away: a column per reference, a row per domain."""
    found = rows.sort(domain=list(DOMAINS), reference=list(REFERENCES)).group("domain", "reference", "distance")
    cells = [cell for cell in found if cell[2] and (*cell[:2], 0.0) in found]
    if not cells:
        raise ValueError("rows must not be empty: nothing was flown both at home and away from it")
    domains, references = (list(dict.fromkeys(cell[i] for cell in cells)) for i in (0, 1))
    height = 1.1 + len(domains) * (0.6 + 0.21 * max(len(by_agent(found[cell])) for cell in cells))
    figure, panels = subplots((1.9 * len(references) + 1.8, height), len(domains), len(references), sharey="row")
    smallest = math.inf
    for domain, reference, distance in cells:
        axes = panels[domains.index(domain), references.index(reference)]
        axes.set_title(f"{DOMAINS[domain].capitalize()}, {REFERENCES[reference]}")
        home, there = (by_agent(found[domain, reference, d]) for d in (0.0, distance))
        smallest = min(smallest, _draw_away(axes, home, there))
    style: Any = {"color": "0.3", "linestyle": ""}
    entries = {
        "at home": Line2D([], [], marker="o", markersize=5, **style),
        away(cells[0][2])[2:]: Line2D([], [], marker=">", markersize=7, **style),
    }
    title = "The same flights at home and away from it" + floor_note(smallest, SMALLEST_ERROR, "\n(", ")")
    return legend_below(figure, title, "mean over seeds", 2, entries)


@mpl.rc_context(STYLE)
def shares(rows: Results, domain: str) -> Figure:
    """Position error before and after each way to adapt, and of the true vehicle [cm], a panel per reference."""
    found = gaps(rows, domain)
    names = [name for name in REFERENCES if any(name in line for line in found.values())]
    if not names:
        raise ValueError(f"rows must hold a source model and the true vehicle in {domain}")
    figure, panels = _grid(len(names), [agent.name for agent in found])
    at_home = rows.where(domain=domain, distance=0.0)
    for axes, name in zip(panels, names, strict=False):
        flown = by_agent(at_home.where(reference=name))
        errors = {agent: 100 * group.spread(ERROR).mean for agent, group in flown.items()}
        axes.axvline(errors[ORACLE], color="0.4", linestyle=":", label="true vehicle in the mean wind")
        for y, agent in enumerate(found):
            before, after = errors[Agent(SOURCES[agent.model])], errors.get(agent, math.inf)
            axes.plot([before, after], [y, y], color=COLOURS_OF[agent.model], linewidth=1)
            axes.plot(before, y, "o", color=COLOURS_OF[agent.model], markerfacecolor="white", label="not adapted")
            axes.plot(after, y, "o", color=COLOURS_OF[agent.model], label="adapted")
        axes.set(title=REFERENCES[name], xlabel="position RMSE [cm]", xlim=(0, None))
        name_lines(axes, [agent.name for agent in found])
    known = {label: Line2D([], [], color="0.3", marker="o", linestyle="") for label in ("not adapted", "adapted")}
    known["not adapted"].set_markerfacecolor("white")
    return legend_below(
        figure, f"{DOMAINS[domain].capitalize()}: how closely it flies (lower is better)", entries=known
    )


@mpl.rc_context(STYLE)
def open_loop_costs(rows: Results, agents: Sequence[Agent]) -> Figure:
    """Actual over predicted cost of plans: a panel per domain, a line per model, a dot per reference (mean)."""
    found = {domain: rows.where(domain=domain, distance=0.0) for domain in DOMAINS if domain in rows["domain"]}
    if not any(agent in by_agent(group) for group in found.values() for agent in agents):
        raise ValueError("rows must hold one of the agents: there is nothing to draw")
    size = plots.PAGE, 1.3 + 0.22 * len(agents)
    figure, (panels,) = subplots(size, 1, len(found), sharex=True, sharey=True)
    for axes, (domain, group) in zip(panels, found.items(), strict=True):
        axes.axvspan(1 - COST_TOLERANCE, 1 + COST_TOLERANCE, color="0.85", label="within 10 %")
        _draw_costs(axes, group, agents)
        axes.set(title=DOMAINS[domain].capitalize(), xlabel="actual / predicted cost", xscale="log")
        name_lines(axes, [agent.name for agent in agents])
    return legend_below(figure, "Do plans cost what they predict? (a dot is a reference; 1 is best)")


def floor_note(smallest: float, floor: float, before: str, after: str = "") -> str:
    """A remark for a title, if any error [cm] is below the floor at which it is drawn."""
    return f"{before}below {floor:g} cm drawn there{after}" if smallest < floor else ""


def _grid(count: int, labels: Sequence[str], width: float = 1.9) -> tuple[Figure, list[Axes]]:
    """So many panels, with room for the labels of lines in the first column."""
    columns = 2 if count == 4 else min(count, 3)
    rows, room = -(-count // columns), 0.06 * max(map(len, labels))
    size = width * columns + room, rows * (0.8 + 0.17 * len(set(labels))) + 0.6
    figure, panels = subplots(size, rows, columns)
    for i, axes in enumerate(panels.flat):
        axes.tick_params(labelleft=i % columns == 0)
        axes.set_visible(i < count)
    return figure, list(panels.flat)


def _draw_away(axes: Axes, home: Mapping[Agent, Results], there: Mapping[Agent, Results]) -> float:
    """Draw mean errors at home and away, joined by a line; returns the smallest [cm]."""
    means = {agent: [100 * each.spread(ERROR).mean for each in (home[agent], rows)] for agent, rows in there.items()}
    values = [value for pair in means.values() for value in pair]
    finite = [max(value, SMALLEST_ERROR) for value in values if math.isfinite(value)] or [1.0]
    edge = max(finite) * 1.8
    axes.set(xscale="log", xlim=(min(finite) / 1.4, edge), xlabel=XLABEL)
    plots.tick_errors(axes.xaxis, *axes.get_xlim())
    name_lines(axes, [agent.name for agent in means])
    for y, (agent, (here, error)) in enumerate(means.items()):
        start, end = max(here, SMALLEST_ERROR), min(max(error, SMALLEST_ERROR), edge)
        colour, crashed = COLOURS_OF[agent.model], sum(there[agent]["crashed"])
        axes.plot([start, end], [y, y], color=colour, linewidth=1)
        axes.plot(start, y, "o", color=colour, markersize=5)
        axes.plot(end, y, "x" if crashed else ">", color=colour, markersize=7, clip_on=False)
        if crashed:
            note(axes, f"{crashed} of {len(there[agent])} crash", (end, y), (-8, 4), va="bottom", ha="right")
        else:
            shown = f"{error:.0f}" if error >= 100 else f"{error:.2g}" if error >= SMALLEST_ERROR else f"{error:.2f}"
            note(axes, shown, (end, y), (7, 0), va="center")
    return min(values)


def _draw_costs(axes: Axes, rows: Results, agents: Sequence[Agent]) -> None:
    for group in rows.group("reference").values():
        flown = by_agent(group.where(lambda row: bool(row["promised"] and row["realised"]), crashed=False))
        for y, agent in enumerate(agents):
            if agent in flown:
                costs = [max(flown[agent].spread(column).mean, SMALLEST_COST) for column in ("promised", "realised")]
                axes.plot(costs[1] / costs[0], y, "o", color=_shade(agent), markersize=5, alpha=0.8)


def _shade(agent: Agent) -> str:
    return COLOURS_OF[agent.model] if agent.n_train else PALE.get(agent.model, COLOURS_OF[agent.model])
