"""Figures: errors of forecasts, and after a change against the number of trajectories."""

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.reaction_diffusion import forecast, shifted
from experiments.reaction_diffusion.report import APHYNITY, SHIFT_WORDS, WAYS, _way
from experiments.reaction_diffusion.shifted import AUTO
from experiments.reporting.names import (
    FINE_TUNED,
    HYBRID,
    LEAST_SQUARES,
    NO_PHYSICS,
    PHYSICS_ONLY,
    SOURCE_ONLY,
    TARGET_ONLY,
)
from experiments.reporting.plots import METHODS, STYLE, Line, colour, dots, legend_below, subplots, tick_errors
from experiments.reporting.results import Results

STYLES = {FINE_TUNED: "-o", TARGET_ONLY: "--s", SOURCE_ONLY: ":", LEAST_SQUARES: "-.^", AUTO: "-D"}
TINTS = {LEAST_SQUARES: METHODS["physics"], AUTO: METHODS["adapted"]}


def draw(rows: Results) -> dict[str, tuple[Figure, str]]:
    found = {}
    if len(own := rows.where(part=forecast.PART)):
        found["forecasts"] = (
            forecasts(own),
            "Error of forecasts of 2.5 s by each model; a dot is a seed, a bar the median",
        )
    if len(own := rows.where(part=shifted.PART)):
        found["scores"] = scores(own), "Error of forecasts after a change, against the number of target trajectories"
    return found


@mpl.rc_context(STYLE)
def forecasts(rows: Results) -> Figure:
    """Draw the error of each model, the best on top, and what APHYNITY published."""
    groups = sorted(rows.group("case").items(), key=lambda group: group[1].spread("mse").median)
    figure, ((axes,),) = subplots(1.2 + 0.28 * len(groups), 1, 1)
    lines = [Line(str(name), own.numbers("mse"), colour(_model(str(name)))) for name, own in groups]
    axes.axvline(APHYNITY, color="0.4", linestyle=":", label="published: APHYNITY, 1600 trajectories")
    dots(axes, lines)
    axes.set_xlabel("mean squared error (log scale; lower is better)")
    return legend_below(figure, "Forecasts of 2.5 s, learned from one trajectory (dot: a seed; bar: median)")


def _model(case: str) -> str:
    return PHYSICS_ONLY if case.startswith("physics alone") else NO_PHYSICS if case.startswith("no physics") else HYBRID


@mpl.rc_context(STYLE)
def scores(rows: Results) -> Figure:
    """Draw the median error of each method, a panel for each change; a dot is a seed."""
    groups = rows.group("shift")
    figure, axes = subplots(3.6, 1, len(groups), sharey=True)
    for panel, (shift, own) in zip(axes[0], groups.items(), strict=True):
        sizes = sorted(set(own["n"]) - {0})
        for model, mode in WAYS:
            mine = own.where(model=model, mode=mode)
            tint = TINTS.get(mode, colour(model)) if model == HYBRID else colour(model)
            if mode == SOURCE_ONLY:
                between = 0 if model == HYBRID else 2, (1, 3)  # two models of one error alternate
                panel.axhline(mine.spread("mse").median, color=tint, linestyle=between, label=_way(model, mode))
                continue
            if not len(mine):
                continue
            values = [mine.where(n=n).numbers("mse") for n in sizes]
            medians = [float(np.median(value)) for value in values]
            panel.plot(sizes, medians, STYLES[mode], color=tint, markersize=4, label=_way(model, mode))
            for n, value in zip(sizes, values, strict=True):
                panel.plot([n] * len(value), value, ".", color=tint, alpha=0.35, markersize=3)
        panel.set(xscale="log", yscale="log", title=SHIFT_WORDS[shift], xlabel="target trajectories N")
        panel.set_xticks(sizes, [str(n) for n in sizes])
        panel.minorticks_off()
    axes[0, 0].set_ylabel("mean squared error\n(log scale; lower is better)")
    tick_errors(axes[0, 0].yaxis, *axes[0, 0].get_ylim())
    return legend_below(figure, "Forecasts after a change", "line: median over seeds; dot: a seed")
