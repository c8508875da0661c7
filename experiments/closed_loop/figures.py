"""Figures of closed-loop flight: errors, before and after adaptation, paths; ValueError if there is nothing to draw."""

import math
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.closed_loop.config import THREE
from experiments.closed_loop.flights import DRAW_EVERY, Flown
from experiments.closed_loop.results import DOMAINS, ERROR, KNOWN, ORACLE, SOURCES, Agent, by_agent, gaps
from experiments.flying.scenario import PATHS, REFERENCES
from experiments.reporting import plots
from experiments.reporting.plots import COLOURS, STYLE, Line, legend_below, name_lines, subplots, tick_errors
from experiments.reporting.results import Results
from hybrid_jax.control import Controller, sample
from hybrid_jax.state import POSITION
from hybrid_jax.vehicle import IRIS

States = Float[np.ndarray, "t 13"]

COLOURS_OF = {
    "nominal": "0.45",
    "physics": COLOURS["physics_only"],
    "hybrid": COLOURS["hybrid"],
    "no_physics": COLOURS["no_physics"],
    "invariant": "#CC79A7",
    "least_squares": "#882255",
    "oracle": "black",
}
SMALLEST_ERROR = 0.01  # cm: smaller errors are drawn here; with the true model a hovering vehicle does not move
XLABEL = "position RMSE [cm]  (log scale)"
LARGEST_SHOWN, SMALLEST_SHOWN = 300.0, 0.02  # cm: errors over time are clipped to these
TOP_VIEW = [0, 1]  # x, y
VIEWS = {"low_pass": [0, 2]}  # x, z: the altitude matters


@mpl.rc_context(STYLE)
def errors(rows: Results, domain: str) -> Figure:
    """Draw a row of panels per question, a column per reference at home; a line per agent, a dot per seed."""
    rows = rows.where(domain=domain, distance=0.0).sort(reference=list(REFERENCES))
    places = {reference: by_agent(group) for reference, group in rows.group("reference").items()}
    if not places:
        raise ValueError(f"rows must not be empty: nothing was flown in {domain}")
    agents = list(dict.fromkeys(agent for group in places.values() for agent in group))
    asked = questions(agents)
    counts = [len(group) for group in asked.values()]
    width = 1.25 * len(places) + 0.075 * max(len(agent.name) for agent in agents)
    size = width, 1.0 + sum(0.55 + 0.2 * n for n in counts)
    figure, panels = subplots(size, len(asked), len(places), height_ratios=counts)
    for line, (question, group) in zip(panels, asked.items(), strict=True):
        for axes, (reference, found) in zip(line, places.items(), strict=True):
            _draw_errors(axes, found, group)
            axes.tick_params(labelleft=axes is line[0], labelbottom=line[0] is panels[-1, 0])
            if line[0] is panels[0, 0]:
                axes.set_title(REFERENCES[reference])
        line[0].text(-0.02, 1.02, question, transform=line[0].transAxes, fontweight="bold", ha="right", va="bottom")
    panels[-1, len(places) // 2].set_xlabel(XLABEL)
    note = floor_note(100 * rows.numbers(ERROR).min(), SMALLEST_ERROR, "; ")
    title = f"{DOMAINS[domain].capitalize()}: position error of each model (not finite: crashed{note})"
    return plots.error_legend(figure, title, any(rows["crashed"]))


def questions(agents: Sequence[Agent]) -> dict[str, list[Agent]]:
    """Return the agents that answer each question; the true vehicle is a line in all panels."""
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


def _draw_errors(axes: Axes, found: Mapping[Agent, Results], group: Sequence[Agent]) -> None:
    def line(agent: Agent) -> Line:
        errors = 100 * found[agent].numbers(ERROR) if agent in found else np.empty(0)
        return Line(agent.name, np.maximum(errors, SMALLEST_ERROR), COLOURS_OF[agent.model])

    plots.error_panel(axes, [line(agent) for agent in group], "", beside=[line(agent) for agent in found])
    axes.set_xlabel("")
    if ORACLE in found and ORACLE not in group:
        best = max(100 * found[ORACLE].spread(ERROR).mean, SMALLEST_ERROR)
        axes.axvline(best, color="black", linestyle=":", linewidth=1, label="the true vehicle as its own model")


@mpl.rc_context(STYLE)
def shares(rows: Results, domain: str) -> Figure:
    """Draw the position error before and after each adaptation, and the true vehicle's [cm], a panel per reference."""
    found = gaps(rows, domain)
    names = [name for name in REFERENCES if any(name in line for line in found.values())]
    if not names:
        raise ValueError(f"rows must have a source model and the true vehicle in {domain}")
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
def paths(
    flights: Mapping[str, Mapping[Agent, States]], references: Mapping[str, States], dt: float, title: str
) -> Figure:
    """Draw a row per reference: the path, and the distance from it, both from states every dt [s]."""
    if not flights:
        raise ValueError("flights must not be empty: there is nothing to draw")
    figure, panels = subplots((9.5, 0.9 + 2.9 * len(flights)), len(flights), 2, width_ratios=(1, 1.25))
    smallest = math.inf
    for (left, right), (reference, flown) in zip(panels, flights.items(), strict=True):
        wanted = references[reference][:, POSITION]
        view = VIEWS.get(reference, TOP_VIEW)
        left.plot(*wanted[:, view].T, color="0.6", linestyle="--", linewidth=2.5, label="reference")
        for agent, states in flown.items():
            dash = ":" if agent.observer else "-" if agent.n_train or agent.model in KNOWN else "--"
            style = {"color": COLOURS_OF[agent.model], "linestyle": dash, "label": agent.name}
            left.plot(*states[:, POSITION][:, view].T, linewidth=1.2, **style)
            error = 100 * np.linalg.norm(states[:, POSITION] - wanted, axis=1)
            smallest = np.fmin(smallest, np.nanmin(error))
            error = np.clip(error, SMALLEST_SHOWN, LARGEST_SHOWN)
            right.plot(dt * np.arange(len(error)), error, linewidth=1.2, **style)
        _frame(left, wanted[:, view], top=view == TOP_VIEW)
        side = "from above" if view == TOP_VIEW else "from the side"
        left.set(xlabel="x [m]", ylabel=f"{'xyz'[view[1]]} [m]", title=f"{REFERENCES[reference]}: {side}")
        right.set(yscale="log", xlabel="time [s]", ylabel="[cm]", title="distance from the reference (log scale)")
        tick_errors(right.yaxis, *right.get_ylim())
    return legend_below(figure, title + floor_note(smallest, SMALLEST_SHOWN, " (", ")"))


def flown_paths(flown: Sequence[Flown], domain: str, agents: Sequence[Agent]) -> Figure:
    own = {each.scenario.name: each for each in flown}
    at_home = {name: own[f"{domain} {name}"] for name in THREE if f"{domain} {name}" in own}
    flights = {name: {agent: each.states(agent) for agent in agents} for name, each in at_home.items()}
    controller = Controller(IRIS)
    dt = DRAW_EVERY * controller.period
    wanted = {}
    for name, states in flights.items():
        length = len(states[agents[0]])
        reference = sample(PATHS[name], controller, dt * (length - 1))
        wanted[name] = np.asarray(reference[: DRAW_EVERY * length : DRAW_EVERY])
    return paths(flights, wanted, dt, f"{DOMAINS[domain].capitalize()}: flights of one seed")


def floor_note(smallest: float, floor: float, before: str, after: str = "") -> str:
    """Return a remark for a title if any error [cm] is below the floor of the drawing."""
    return f"{before}below {floor:g} cm drawn there{after}" if smallest < floor else ""


def _grid(count: int, labels: Sequence[str], width: float = 1.9) -> tuple[Figure, list[Axes]]:
    columns = 2 if count == 4 else min(count, 3)
    rows, room = -(-count // columns), 0.06 * max(map(len, labels))
    size = width * columns + room, rows * (0.8 + 0.17 * len(set(labels))) + 0.6
    figure, panels = subplots(size, rows, columns)
    for i, axes in enumerate(panels.flat):
        axes.tick_params(labelleft=i % columns == 0)
        axes.set_visible(i < count)
    return figure, list(panels.flat)


def _frame(axes: Axes, wanted: Float[np.ndarray, "t 2"], top: bool) -> None:
    """Set limits from the reference, so that a flight that diverges does not shrink the others."""
    low, high = wanted.min(axis=0), wanted.max(axis=0)
    if not top:
        axes.set(xlim=(low[0] - 0.5, high[0] + 0.5), ylim=(0.0, 1.25 * high[1]))
        return
    (x, y), half = (low + high) / 2, max(0.6, 0.62 * (high - low).max())
    axes.set(xlim=(x - half, x + half), ylim=(y - 0.6 * half, y + 0.6 * half), aspect="equal")
