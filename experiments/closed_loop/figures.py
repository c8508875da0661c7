"""Figure of closed-loop flight: the position error before and after adaptation."""

import math

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.closed_loop.results import DOMAINS, ERROR, LEARNED, ORACLE, SOURCES, Agent, by_agent, gaps
from experiments.flying.scenario import REFERENCES
from experiments.reporting.names import EXTERNAL_FORCE
from experiments.reporting.plots import METHODS, STYLE, legend_of, name_lines, subplots, tick_errors
from experiments.reporting.results import Results

SMALLEST = 0.1  # cm, of what is drawn
COLOURS_OF = {"hybrid": METHODS["fine-tuned"], "invariant": "#56B4E9", "least_squares": METHODS["adapted"]}


def draw(rows: Results) -> dict[str, tuple[Figure, str]]:
    domains = [name for name in DOMAINS if gaps(rows, name)]
    about = "Position RMSE before and after adaptation"
    return {f"gap_{name}": (shares(rows, name), f"{about}, {DOMAINS[name]}") for name in domains}


@mpl.rc_context(STYLE)
def shares(rows: Results, domain: str) -> Figure:
    """Draw the error before and after adaptation to the fewest trajectories [cm], a line per reference and model."""
    found = gaps(rows, domain)
    few = min((agent.n_train for agent in found if agent.n_train), default=0)
    models = [name for name in SOURCES if any(agent.model == name for agent in found)]
    names = [name for name in REFERENCES if any(name in line for line in found.values())]
    figure, ((axes,),) = subplots(1.8 + 0.48 * len(names), 1, 1)
    at_home, edge = rows.where(domain=domain, distance=0.0), ""
    for line, name in enumerate(names):
        flown = by_agent(at_home.where(reference=name))
        errors = {agent: 100 * group.spread(ERROR).mean for agent, group in flown.items()}
        edge = f"; {SMALLEST}: or less" if min(errors.values()) < SMALLEST else edge
        errors = {agent: max(error, SMALLEST) for agent, error in errors.items()}
        axes.plot([errors[ORACLE]] * 2, [line - 0.4, line + 0.4], color="0.4", linestyle=":")
        for i, model in enumerate(models):
            y = line + 0.22 * (i - (len(models) - 1) / 2)
            agents = {"o": Agent(SOURCES[model]), "s": Agent(model, few), "D": Agent(model, few, observer=True)}
            marked = {mark: errors.get(agent, math.inf) for mark, agent in agents.items()}
            drawn = [error for error in marked.values() if math.isfinite(error)]
            axes.plot(drawn, [y] * len(drawn), color=COLOURS_OF[model], linewidth=1)
            for mark, error in marked.items():
                style = {"color": COLOURS_OF[model], "markerfacecolor": "white" if mark == "o" else None}
                axes.plot(error, y, mark, **style)
    axes.set(xscale="log", xlabel=f"position RMSE [cm]\n(log scale; lower is better{edge})")
    tick_errors(axes.xaxis, *axes.get_xlim(), room=3.0)
    name_lines(axes, [REFERENCES[name] for name in names])
    known: dict[str, Artist] = {LEARNED[name]: Line2D([], [], color=COLOURS_OF[name], lw=3) for name in models}
    for label, mark in {"not adapted": "o", "adapted": "s", "adapted, with an observer": "D"}.items():
        known[label] = Line2D([], [], color="0.3", marker=mark, linestyle="")
    known["not adapted"].set(markerfacecolor="white")
    true = "true vehicle in the mean wind" if domain == EXTERNAL_FORCE else "true vehicle"
    known[true] = Line2D([], [], color="0.4", linestyle=":")
    title = f"{DOMAINS[domain].capitalize()}: how closely a model flies, adapted to {few} trajectories"
    return legend_of(known, figure, title, "", 2)
