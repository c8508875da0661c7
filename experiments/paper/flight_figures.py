"""Figure of predicted flights and the truth (Figs. 2 and 4), from numbers that a report keeps."""

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.reporting.names import label
from experiments.reporting.plots import DRAWABLE, STYLE, WIDTH, colour, legend_below
from hybrid_jax.vehicle import POSITION

MIN_HALF_WIDTH = 0.2  # m, of a view: a hovering vehicle is not magnified beyond it
VIEW_RATIO = 1.7  # width of a view over the extent of the truth
SMALLEST = 1e-6  # m, of an error on a log axis
DECADES = 4  # of errors that are shown
MOST = 100.0  # m: no error beyond it is shown

Flights = Float[np.ndarray, "n t+1 13"]


def parted(predicted: Mapping[int, Mapping[str, Flights]], truth: Flights, shown: int, dt: float) -> dict[str, Any]:
    """Return what `predictions` draws: the `shown` flight from above, and quantiles of the error of all flights."""

    def of_model(states: Flights) -> dict[str, Any]:
        with np.errstate(all="ignore"):
            errors = np.linalg.norm(states[:, 1:, POSITION] - truth[:, 1:, POSITION], axis=-1)
        errors = np.where(errors < DRAWABLE, errors, DRAWABLE)  # a flight that diverged counts as the worst
        return {"path": _above(states[shown]), "errors": np.quantile(errors, (0.1, 0.5, 0.9), axis=0)}

    sizes = {str(n): {name: of_model(states) for name, states in of.items()} for n, of in sorted(predicted.items())}
    return {"flights": len(truth), "dt": dt, "truth": _above(truth[shown]), "sizes": sizes}


def _above(states: Float[np.ndarray, "t 13"]) -> np.ndarray:
    path = states[:, POSITION][:, :2]
    return np.where(np.abs(path) < DRAWABLE, path, DRAWABLE)


@mpl.rc_context(STYLE)
def predictions(paths: Mapping[str, Any], title: str) -> Figure:
    """Figs. 2 and 4: a flight from above, and how the position error of all flights grows, by N and model."""
    figure = Figure(figsize=(WIDTH, 4.0), layout="constrained")
    grid = figure.add_gridspec(2, len(paths["sizes"]), height_ratios=(1.3, 1))
    first = None
    for column, (n, models) in enumerate(paths["sizes"].items()):
        above = figure.add_subplot(grid[0, column])
        _draw_from_above(above, np.array(paths["truth"]), {name: np.array(own["path"]) for name, own in models.items()})
        above.set(title=f"N = {n}", xlabel="x [m]", ylabel="" if column else "one flight from above\ny [m]")
        first = axes = figure.add_subplot(grid[1, column], sharey=first)
        for name, own in models.items():
            low, middle, high = np.maximum(own["errors"], SMALLEST)
            time = paths["dt"] * np.arange(1, len(middle) + 1)
            axes.plot(time, middle, color=colour(name), label=label(name))
            axes.fill_between(time, low, high, color=colour(name), alpha=0.15, linewidth=0)
        axes.set(xlabel="time [s]", yscale="log", ylabel="" if column else "position error [m]")
        axes.tick_params(labelleft=column == 0)
    assert first is not None
    top = min(first.get_ylim()[1], MOST)
    first.set_ylim(top / 10.0**DECADES, top)
    meaning = "seen from above, ●: end, ×: where a prediction leaves the view; errors: median and 10 to 90 % of flights"
    return legend_below(figure, f"{title}: predictions of {paths['flights']} test flights", meaning, columns=4)


def _draw_from_above(
    axes: Axes, path: Float[np.ndarray, "t 2"], models: Mapping[str, Float[np.ndarray, "t 2"]]
) -> None:
    """Draw paths in a square around the truth; a prediction that leaves it ends with ×."""
    centre, extent = (path.min(axis=0) + path.max(axis=0)) / 2, np.ptp(path, axis=0).max()
    half = max(MIN_HALF_WIDTH, VIEW_RATIO * extent / 2)
    axes.plot(*path.T, color="0.8", linewidth=6, label="truth", solid_capstyle="round")  # wide, so that none hides it
    axes.plot(*path[:1].T, "o", color="black", markerfacecolor="white", label="start")
    for name, drawn in models.items():
        inside = np.all(np.abs(drawn - centre) <= half, axis=1)
        end = len(inside) if inside.all() else int(np.argmin(inside))
        axes.plot(*drawn[:end].T, color=colour(name), linewidth=1.5)
        axes.plot(*drawn[max(end - 1, 0)], "o" if end == len(inside) else "x", color=colour(name), markersize=5)
    axes.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] - half, centre[1] + half), aspect="equal")
