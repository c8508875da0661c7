"""Figure of flights with a change in the air: the error of each agent, in the first second and after it."""

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.flying.scenario import REFERENCES
from experiments.online.agents import AGENTS
from experiments.online.results import SETTLED, error
from experiments.reporting.names import label
from experiments.reporting.plots import METHODS, STYLE, legend_below, name_lines, subplots, tick_errors, wrapped
from experiments.reporting.results import Results

MARKS = {  # colour and marker of each agent
    "unadapted": (METHODS["not adapted"], "x"),
    "l1": ("#8C510A", "v"),
    "observer": ("#E69F00", "s"),
    "least_squares": (METHODS["physics"], "^"),
    "online": (METHODS["adapted"], "o"),
    "oracle": ("black", "|"),
}
TIMES = {"first_second": "in the first second after the change", "settled": f"from {SETTLED:g} s after it on"}


def draw(rows: Results) -> dict[str, tuple[Figure, str]]:
    references = rows.unique("reference")
    shown = "figure_eight" if "figure_eight" in references else str(references[0])
    return {
        "errors": (errors(rows, shown), "Distance from the reference after a change; a line reaches over all seeds")
    }


@mpl.rc_context(STYLE)
def errors(rows: Results, reference: str) -> Figure:
    """Draw the mean over seeds of each agent on one reference, for each world and change, without crashed flights."""
    own = rows.where(reference=reference)
    changes, agents = own.unique("change"), [name for name in MARKS if name in own.unique("agent")]
    worlds = own.unique("world")
    figure, grid = subplots(0.9 + (0.6 + 0.4 * len(changes)) * len(worlds), len(worlds), len(TIMES), sharey=True)
    for world, panels in zip(worlds, grid, strict=True):
        for axes, (column, when) in zip(panels, TIMES.items(), strict=True):
            axes.set(xscale="log", title=f"{label(world)},\n{wrapped(when, 24)}")
            for y, change in enumerate(changes):
                for i, agent in enumerate(agents):
                    found = own.where(world=world, change=change, agent=agent).numbers(error(column))
                    place, (tint, marker) = y + 0.13 * (i - (len(agents) - 1) / 2), MARKS[agent]
                    if len(found := found[np.isfinite(found)]):
                        axes.plot([found.min(), found.max()], [place] * 2, color=tint, linewidth=2.5, alpha=0.3)
                        style = {"markersize": 4, "label": AGENTS[agent], "linestyle": ""}
                        axes.plot(found.mean(), place, marker, color=tint, **style)
            name_lines(axes, [label(change) for change in changes])
            tick_errors(axes.xaxis, *axes.get_xlim())
    for axes in grid[-1]:
        axes.set_xlabel("RMS distance [cm]\n(log scale)")
    return legend_below(figure, f"Distance from the reference, {REFERENCES[reference]} (lower is better)")
