"""Figure of closed-loop flight: the position error before and after adaptation."""

import math

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.closed_loop.results import DOMAINS, ERROR, ORACLE, SOURCES, Agent, by_agent, gaps
from experiments.flying.scenario import REFERENCES
from experiments.reporting.names import EXTERNAL_FORCE
from experiments.reporting.plots import METHODS, PAGE, STYLE, legend_below, name_lines, subplots
from experiments.reporting.results import Results

COLOURS_OF = {"hybrid": METHODS["fine-tuned"], "invariant": "#56B4E9", "least_squares": METHODS["adapted"]}


def draw(rows: Results) -> dict[str, tuple[Figure, str]]:
    domains = [name for name in DOMAINS if gaps(rows, name)]
    about = "Position RMSE before and after adaptation"
    return {f"gap_{name}": (shares(rows, name), f"{about}, {DOMAINS[name]}") for name in domains}


@mpl.rc_context(STYLE)
def shares(rows: Results, domain: str) -> Figure:
    """Draw the error before and after adaptation to the fewest trajectories [cm], a panel per reference; ×: crash."""
    found = gaps(rows, domain)
    few = min((agent.n_train for agent in found if agent.n_train), default=0)
    agents = [agent for agent in found if agent.n_train == few]
    names = [name for name in REFERENCES if any(name in line for line in found.values())]
    columns = min(len(names), 3)
    lines = -(-len(names) // columns)
    figure, panels = subplots((PAGE, 0.9 + lines * (0.6 + 0.17 * len(agents))), lines, columns, sharey=True)
    for axes in panels.flat[len(names) :]:
        axes.set_visible(False)
    true = "true vehicle in the mean wind" if domain == EXTERNAL_FORCE else "true vehicle"
    at_home = rows.where(domain=domain, distance=0.0)
    for axes, name in zip(panels.flat, names, strict=False):
        flown = by_agent(at_home.where(reference=name))
        errors = {agent: 100 * group.spread(ERROR).mean for agent, group in flown.items()}
        axes.axvline(errors[ORACLE], color="0.4", linestyle=":", label=true)
        for y, agent in enumerate(agents):
            before, after = errors[Agent(SOURCES[agent.model])], errors.get(agent, math.inf)
            axes.plot([before, after], [y, y], color=COLOURS_OF[agent.model], linewidth=1)
            axes.plot(before, y, "o", color=COLOURS_OF[agent.model], markerfacecolor="white", clip_on=False)
            axes.plot(after, y, "o", color=COLOURS_OF[agent.model], clip_on=False)
        axes.set(title=REFERENCES[name], xlim=(0, None))
        name_lines(axes, [agent.name for agent in agents])
    for axes in panels[-1]:
        axes.set_xlabel("position RMSE [cm]")
    known = {label: Line2D([], [], color="0.3", marker="o", linestyle="") for label in ("not adapted", "adapted")}
    known["not adapted"].set_markerfacecolor("white")
    title = f"{DOMAINS[domain].capitalize()}: how closely it flies (lower is better)"
    return legend_below(figure, title, entries=known)
