"""Figures of flights: predicted paths in the horizontal plane (Figs. 2 and 4) and an example of the data (Fig. 7)."""

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.reporting.names import HYBRID, label
from experiments.reporting.plots import COLOURS, STYLE, colour, legend_below, subplots
from hybrid_jax.state import INPUT_NAMES, INPUT_SIZE, POSITION, QUATERNION, VELOCITY

MIN_HALF_WIDTH = 0.2  # m, of a view: a hovering vehicle is not magnified beyond it
VIEW_RATIO = 1.6  # width of a view over the extent of the truth

States = Float[np.ndarray, "t+1 13"]


@mpl.rc_context(STYLE)
def predictions(truth: States, predicted: Mapping[int, Mapping[str, States]], title: str) -> Figure:
    """Figs. 2 and 4: one test flight in the horizontal plane, a panel for each N, every model against the truth.

    The truth alone sets the view; a prediction, N → model → its states, that leaves it is cut, and the panel says so.
    """
    figure, (panels,) = subplots((3.1 * max(len(predicted), 2), 4.1), 1, len(predicted), sharey=True)
    for axes, (n, models) in zip(panels, sorted(predicted.items()), strict=True):
        _draw_paths(axes, truth, models)
        axes.set(title=f"N = {n} trajectories", xlabel="x [m]")
    panels[0].set_ylabel("y [m]")
    return legend_below(figure, title, columns=4)


@mpl.rc_context(STYLE)
def example_flight(states: States, inputs: Float[np.ndarray, "t 4"], dt: float) -> Figure:
    """Fig. 7: the path in space, and altitude, speed, tilt and rotor speeds [rad/s], held for dt [s], over time."""
    time = dt * np.arange(len(states))
    figure = Figure(figsize=(9, 5.4), layout="constrained")
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
    rotors.legend(ncols=INPUT_SIZE, loc="upper right", fontsize=7, columnspacing=1, handlelength=1, frameon=True)
    figure.align_ylabels(panels)
    figure.suptitle("An example flight of the data", fontsize=12)
    return figure


def _draw_paths(axes: Axes, truth: States, models: Mapping[str, States]) -> None:
    start, path = truth[0, :2], truth[:, :2]
    centre = (path.min(axis=0) + path.max(axis=0)) / 2
    half = max(MIN_HALF_WIDTH, VIEW_RATIO * np.ptp(path, axis=0).max() / 2)
    for name, states in models.items():
        # A path ends where it first is not finite, or so far off that drawing it would overflow.
        near = np.all(np.abs(states[:, :2] - centre) < 1e3 * half, axis=1)
        drawn = states[: len(near) if near.all() else int(np.argmin(near)), :2]
        shown, tint = label(name), colour(name)
        axes.plot(*drawn.T, color=tint, linewidth=1.8, marker=".", markersize=4, label=shown)
        if np.all(np.abs(states[:, :2] - centre) <= half):
            continue
        with np.errstate(over="ignore"):
            off = np.linalg.norm(states[:, :2] - centre, axis=1).max()
        words = f"{shown} leaves the view,\nup to {off:.2g} m off" if np.isfinite(off) else f"{shown} ends: not finite"
        y = 0.02 + 0.12 * len(axes.texts)
        axes.text(0.03, y, words, transform=axes.transAxes, color=tint, fontsize=8, va="bottom")
    axes.plot(*path.T, color="black", linestyle="--", linewidth=1.5, label="truth", zorder=4)
    axes.plot(*start, marker="o", color="black", markerfacecolor="white", linestyle="", label="start", zorder=5)
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
    """The angle between body z and world z [deg]."""
    return np.degrees(np.arccos(np.clip(1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2), -1, 1)))
