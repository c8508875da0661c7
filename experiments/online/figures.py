"""Figures of flights with a change in the air: errors and parameters over time."""

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.flying.scenario import REFERENCES
from experiments.online.agents import AGENTS, CHANGE_NAMES, CHANGES, NAMES, PARTS, true_theta
from experiments.online.config import OnlineConfig
from experiments.online.flights import Run
from experiments.reporting.plots import PAGE, STYLE, legend_below, subplots, tick_errors
from hybrid_jax.sim.forces import WIND_MEAN
from hybrid_jax.vehicle import IRIS

COLOURS = {
    "unadapted": "0.55",
    "observer": "#CC79A7",
    "l1": "#E69F00",
    "least_squares": "#009E73",
    "online": "#0072B2",
    "oracle": "black",
}
BEFORE = 0.5  # s that are shown before the change
Z = 1.96
# Change → name in θ of what is shown, what the figure calls it, and the axis, in the physics' own parametrisation.
SHOWN: Mapping[str, tuple[dict[str, str], str]] = {
    "inertia": ({"Ix": "log Ix / nominal", "Iy": "log Iy / nominal"}, "log ratio"),
    "load": (
        {"efficiency 0": "log efficiency of rotor 0", "centre_of_mass x": "centre of mass x / arm"},
        "log ratio; offset / arm",
    ),
    "wind": ({"vy": "disturbance of $v_y$ [m/s²]"}, "disturbance [m/s²]"),
    "weak_rotor": ({"efficiency 0": "log efficiency of rotor 0", "efficiency 1": "of rotor 1"}, "log efficiency"),
    "drag": ({"drag x": "added drag, body x [1/s]", "drag y": "body y"}, "added drag [1/s]"),
    "nothing": ({"efficiency 0": "log efficiency of rotor 0", "Ix": "log Ix / nominal"}, "log ratio"),
}
THETA = (*NAMES, "vx", "vy", "vz")


def indices(run: Run, **tags) -> list[int]:
    return [i for i, own in enumerate(run.trials) if tags.items() <= own._asdict().items()]


def whole(run: Run, i: int, name: str) -> np.ndarray:
    return np.concatenate([getattr(run.before[run.trials[i].start], name), getattr(run.after, name)[i]])


def _panels(config: OnlineConfig):
    rows = -(-len(config.changes) // 2)
    figure, panels = subplots((PAGE, 1.9 * rows + 0.9), rows, 2, sharex=True)
    for panel in panels.flat:
        panel.axvline(0, color="0.7", linestyle=":", linewidth=1)
    for panel in panels[-1]:
        panel.set_xlabel("time after the change [s]")
        panel.xaxis.set_major_locator(MaxNLocator(5))
    return figure, panels


def _times(config: OnlineConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return times after the change [s], and which of them are shown."""
    times = config.controller().period * (np.arange(2 * config.periods) + 1 - config.periods)
    return times, times > -BEFORE


@mpl.rc_context(STYLE)
def errors(run: Run, config: OnlineConfig, reference: str) -> Figure:
    """Draw the RMS distance from the reference over seeds against time, a panel for each change."""
    figure, panels = _panels(config)
    for panel, change in zip(panels.flat, config.changes, strict=False):
        for agent in dict.fromkeys(trial.agent for trial in run.trials):
            own = np.stack(
                [whole(run, i, "error") for i in indices(run, change=change, agent=agent, reference=reference)]
            )
            times, shown = _times(config)
            rms = 100 * np.sqrt(np.mean(np.square(own), axis=0))
            width = 1.6 if agent in ("online", "oracle") else 1.0
            panel.plot(times[shown], rms[shown], color=COLOURS[agent], linewidth=width, label=AGENTS[agent])
        panel.set(title=CHANGE_NAMES[change], yscale="log", ylabel="error [cm]")
        tick_errors(panel.yaxis, *panel.get_ylim())
    return legend_below(figure, f"Distance from the reference, {REFERENCES[reference]}: RMS over seeds", columns=2)


@mpl.rc_context(STYLE)
def parameters(run: Run, config: OnlineConfig, reference: str) -> Figure:
    figure, panels = _panels(config)
    for panel, change in zip(panels.flat, config.changes, strict=False):
        i = indices(run, change=change, agent="online", reference=reference, seed=0)[0]
        theta, std = whole(run, i, "theta"), whole(run, i, "std")
        times, shown = _times(config)
        names, axis = SHOWN[change]
        places = [THETA.index(name) for name in names]
        for index, label, colour in zip(places, names.values(), ("#0072B2", "#D55E00"), strict=False):
            middle, away = theta[shown, index], Z * std[shown, index]
            panel.plot(times[shown], middle, color=colour, linewidth=1.2)
            panel.fill_between(times[shown], middle - away, middle + away, color=colour, alpha=0.2, linewidth=0)
            truth = np.where(times[shown] < 0, 0.0, _truth(change, index))
            panel.plot(times[shown], truth, color=colour, linestyle="--", linewidth=1)
            place = 0.98, 0.05 if index == places[0] else 0.88
            panel.annotate(label, place, xycoords="axes fraction", color=colour, ha="right", fontsize=7)
        values = np.concatenate([theta[shown, index] for index in places])
        truths = [_truth(change, index) for index in places]
        low, high = min(values[-100:].min(), *truths, 0), max(values[-100:].max(), *truths, 0)
        room = 0.8 * (high - low) + 0.05
        panel.set(title=CHANGE_NAMES[change], ylabel=axis, ylim=(low - room, high + room))
    title = f"Seed 0, {REFERENCES[reference]}: estimates, 95 % intervals, truth (dashed; of wind its mean)"
    figure.suptitle(title, fontsize=9)
    return figure


def _truth(change: str, index: int) -> float:
    if index < PARTS:
        return float(true_theta(CHANGES[change])[index])
    return WIND_MEAN / IRIS.mass if change == "wind" else 0.0
