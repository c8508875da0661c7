"""Figures: fields over time, spectra, errors against the number of trajectories."""

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.reaction_diffusion import shifted
from experiments.reaction_diffusion.config import LOCAL, POINTWISE
from experiments.reaction_diffusion.gray_scott import SOLVED
from experiments.reaction_diffusion.report import SHIFT_WORDS, WAYS, _way
from experiments.reaction_diffusion.shifted import AUTO
from experiments.reporting.names import FINE_TUNED, HYBRID, LEAST_SQUARES, SOURCE_ONLY, TARGET_ONLY
from experiments.reporting.plots import PAGE, STYLE, colour, legend_below, subplots, tick_errors
from experiments.reporting.results import Results
from hybrid_jax.io.archive import Arrays

STYLES = {FINE_TUNED: "-o", TARGET_ONLY: "--s", SOURCE_ONLY: ":", LEAST_SQUARES: "-.^", AUTO: "-D"}
TINTS = {LEAST_SQUARES: "#CC79A7", AUTO: "#009E73"}
Shown = Arrays


def draw(rows: Results, shown: Shown, patterns: Shown, dt: float) -> dict[str, tuple[Figure, str]]:
    found = {}
    known = [name for name in (POINTWISE, LOCAL) if name in shown]
    if known:
        caption = f"u of a test trajectory of FitzHugh–Nagumo: truth, forecast of {known[0]}, and the error"
        found["fields"] = fields(shown, known[0], (0, 4, 9, 24), dt), caption
    own = rows.where(part=shifted.PART)
    if len(own):
        found["scores"] = scores(own), "Error of forecasts after a change, against the number of target trajectories"
    if patterns:
        caption = "v of Gray–Scott in a new environment: truth, forecast with F and k adapted, and the error"
        found["gray_scott"] = fields(patterns, SOLVED, (0, 2, 5, 8), 40.0, 1), caption
    return found


@mpl.rc_context(STYLE)
def fields(shown: Shown, name: str, at: tuple[int, ...], dt: float, component: int = 0) -> Figure:
    truth, forecast = (_component(shown[each], component) for each in ("truth", name))
    error = forecast - truth
    figure, axes = subplots((PAGE * 0.8, PAGE * 0.8 * 3 / len(at) * 0.98), 3, len(at))
    low, high, most = truth.min(), truth.max(), np.abs(error[list(at)]).max() or 1.0
    limits = {"truth": (truth, low, high, "viridis"), "forecast": (forecast, low, high, "viridis")}
    limits["error"] = (error, -most, most, "RdBu_r")
    for row, (label, (values, least, largest, colours)) in zip(axes, limits.items(), strict=True):
        for panel, step in zip(row, at, strict=True):
            image = panel.imshow(values[step], vmin=least, vmax=largest, cmap=colours, interpolation="nearest")
            panel.set(xticks=[], yticks=[])
            if label == "truth":
                panel.set_title(f"{(step + 1) * dt:.3g} s")
        row[0].set_ylabel(label)
        figure.colorbar(image, ax=list(row), shrink=0.9, aspect=12)
    return figure


@mpl.rc_context(STYLE)
def scores(rows: Results) -> Figure:
    """Draw the median error of each method, a panel for each change; a dot is a seed."""
    groups = rows.group("shift")
    figure, axes = subplots((PAGE, 3.2), 1, len(groups), sharey=True)
    for panel, (shift, own) in zip(axes[0], groups.items(), strict=True):
        sizes = sorted(set(own["n"]) - {0})
        for model, mode in WAYS:
            mine = own.where(model=model, mode=mode)
            tint = TINTS.get(mode, colour(model)) if model == HYBRID else colour(model)
            if mode == SOURCE_ONLY:
                panel.axhline(mine.spread("mse").median, color=tint, linestyle=":", label=_way(model, mode))
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
    axes[0, 0].set_ylabel("mean squared error")
    tick_errors(axes[0, 0].yaxis, *axes[0, 0].get_ylim())
    return legend_below(figure, meaning="line: median over seeds; dot: a seed; lower is better", columns=3)


def _component(states: np.ndarray, component: int) -> np.ndarray:
    """Return one of two components of the first trajectory's states (t, d), as squares (t, side, side)."""
    side = round((states.shape[-1] / 2) ** 0.5)
    return states[0].reshape(-1, 2, side, side)[:, component]
