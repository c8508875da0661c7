"""Figures of flights: predictions and the truth (Figs. 2 and 4), and an example of the data (Fig. 7)."""

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.reporting.names import HYBRID, label
from experiments.reporting.plots import COLOURS, DRAWABLE, PAGE, STYLE, colour, legend_below
from hybrid_jax.state import INPUT_NAMES, INPUT_SIZE, POSITION, QUATERNION, VELOCITY

MIN_HALF_WIDTH = 0.2  # m, of a view: a hovering vehicle is not magnified beyond it
VIEW_RATIO = 1.3  # width of a view over the extent of the truth
SMALLEST = 1e-6  # m, of an error on a log axis
DECADES = 4  # of errors that are shown
MOST = 100.0  # m: no error beyond it is shown

States = Float[np.ndarray, "t+1 13"]
Flights = Float[np.ndarray, "n t+1 13"]


@mpl.rc_context(STYLE)
def predictions(
    predicted: Mapping[int, Mapping[str, Flights]], truth: Flights, shown: int, dt: float, title: str
) -> Figure:
    """Figs. 2 and 4: the `shown` flight from above, and how the position error of all flights grows, by N and model."""
    sizes = sorted(predicted)
    figure = Figure(figsize=(PAGE, 5.0), layout="constrained")
    grid = figure.add_gridspec(2, len(sizes), height_ratios=(1.3, 1))
    first = None
    for column, n in enumerate(sizes):
        above = figure.add_subplot(grid[0, column])
        _draw_from_above(above, truth[shown], {name: states[shown] for name, states in predicted[n].items()})
        above.set(title=f"N = {n}", xlabel="x [m]", ylabel="" if column else "one flight from above\ny [m]")
        first = axes = figure.add_subplot(grid[1, column], sharey=first)
        _draw_growth(axes, predicted[n], truth, dt)
        axes.set(xlabel="time [s]", yscale="log", ylabel="" if column else "position error [m]")
        axes.tick_params(labelleft=column == 0)
    assert first is not None
    top = min(first.get_ylim()[1], MOST)
    first.set_ylim(top / 10.0**DECADES, top)
    meaning = "from above ●: end, ×: where a prediction leaves the view; errors: median and 10 to 90 % of flights"
    return legend_below(figure, title, meaning, columns=4)


@mpl.rc_context(STYLE)
def example_flight(states: States, inputs: Float[np.ndarray, "t 4"], dt: float) -> Figure:
    """Fig. 7: the path in space, and altitude, speed, tilt and rotor speeds [rad/s], held for dt [s], over time."""
    time = dt * np.arange(len(states))
    figure = Figure(figsize=(PAGE, 4.6), layout="constrained")
    grid = figure.add_gridspec(4, 2, width_ratios=(1.15, 1))
    _draw_space(figure.add_subplot(grid[:, 0], projection="3d"), states)
    panels = [figure.add_subplot(grid[row, 1]) for row in range(4)]
    lines = {
        "altitude\n[m]": states[:, POSITION][:, 2],
        "speed\n[m/s]": np.linalg.norm(states[:, VELOCITY], axis=1),
        "tilt\n[°]": tilt(states[:, QUATERNION]),
    }
    for axes, (name, values) in zip(panels, lines.items(), strict=False):
        axes.sharex(panels[-1])
        axes.plot(time, values, color=colour(HYBRID))
        axes.set_ylabel(name)
        axes.tick_params(labelbottom=False)
    rotors = panels[-1]
    for index, (name, tint) in enumerate(zip(INPUT_NAMES, COLOURS.values(), strict=False)):
        rotors.stairs(inputs[:, index], time, baseline=None, color=tint, label=name, linewidth=1)
    rotors.set(xlabel="time [s]", ylabel="rotors\n[rad/s]")
    rotors.legend(ncols=INPUT_SIZE, loc="upper right", fontsize=6, columnspacing=1, handlelength=1, frameon=True)
    figure.align_ylabels(panels)
    figure.suptitle("An example flight of the data")
    return figure


def _draw_growth(axes: Axes, models: Mapping[str, Flights], truth: Flights, dt: float) -> None:
    time = dt * np.arange(1, truth.shape[1])
    for name, states in models.items():
        with np.errstate(all="ignore"):
            errors = np.linalg.norm(states[:, 1:, POSITION] - truth[:, 1:, POSITION], axis=-1)
        errors = np.where(errors < DRAWABLE, errors, DRAWABLE)  # a flight that diverged counts as the worst
        low, middle, high = np.maximum(np.quantile(errors, (0.1, 0.5, 0.9), axis=0), SMALLEST)
        axes.plot(time, middle, color=colour(name), label=label(name))
        axes.fill_between(time, low, high, color=colour(name), alpha=0.15, linewidth=0)


def _draw_from_above(axes: Axes, truth: States, models: Mapping[str, States]) -> None:
    """Draw paths in x and y, in a square around the truth; a prediction that leaves it ends with ×."""
    path = truth[:, POSITION][:, :2]
    centre, extent = (path.min(axis=0) + path.max(axis=0)) / 2, np.ptp(path, axis=0).max()
    half = max(MIN_HALF_WIDTH, VIEW_RATIO * extent / 2)
    axes.plot(*path.T, color="0.8", linewidth=6, label="truth", solid_capstyle="round")  # wide, so that none hides it
    axes.plot(*path[:1].T, "o", color="black", markerfacecolor="white", label="start")
    for name, states in models.items():
        drawn = states[:, POSITION][:, :2]
        inside = np.all(np.abs(drawn - centre) <= half, axis=1)
        end = len(inside) if inside.all() else int(np.argmin(inside))
        axes.plot(*drawn[:end].T, color=colour(name), linewidth=1.5)
        axes.plot(*drawn[max(end - 1, 0)], "o" if end == len(inside) else "x", color=colour(name), markersize=5)
    axes.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] - half, centre[1] + half), aspect="equal")


def _draw_space(axes: Any, states: States) -> None:
    x, y, z = states[:, POSITION].T
    axes.plot(x, y, z, color=colour(HYBRID))
    axes.plot(x, y, np.zeros_like(z), color="0.7", linewidth=1)
    axes.plot(x[:1], y[:1], z[:1], "o", color="black", markerfacecolor="white")
    axes.text(x[0], y[0], z[0], "  start")
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title="Path (grey: its shadow on the ground)")
    axes.set_zlim(bottom=0)
    axes.locator_params(nbins=5)
    axes.set_box_aspect(None, zoom=0.8)  # room for the label of z


def tilt(q: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    return np.degrees(np.arccos(np.clip(1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2), -1, 1)))
