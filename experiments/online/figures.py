"""Figures of flights with a change in the air: errors and parameters over time, and an animated picture."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.flying.scenario import REFERENCES
from experiments.online.agents import AGENTS, CHANGE_NAMES, CHANGES, PARTS, true_theta
from experiments.online.flights import CHANGE, SHOWN_EVERY, Run, Setup
from experiments.reporting.plots import PAGE, STYLE, legend_below, subplots, tick_errors
from hybrid_jax.sim.forces import WIND_MEAN
from hybrid_jax.state import POSITION
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
ANIMATED = ("unadapted", "online")
FRAMES_PER_SECOND, FRAME_EVERY = 10, 10  # of the animated picture; periods
Z = 1.96
# Change → what is shown: index in θ and its name, in the physics' own parametrisation.
SHOWN: Mapping[str, tuple[tuple[int, str], ...]] = {
    "inertia": ((0, "log Ix / nominal"), (1, "log Iy / nominal")),
    "load": ((5, "log efficiency of rotor 0"), (3, "centre of mass x / arm")),
    "wind": ((PARTS + 1, "disturbance of $v_y$ [m/s²]"),),
    "weak_rotor": ((5, "log efficiency of rotor 0"), (6, "of rotor 1")),
    "drag": ((9, "added drag, body x [1/s]"), (10, "body y")),
    "nothing": ((5, "log efficiency of rotor 0"), (0, "log Ix / nominal")),
}
AXES = {
    "inertia": "log ratio",
    "load": "log ratio; offset / arm",
    "wind": "disturbance [m/s²]",
    "weak_rotor": "log efficiency",
    "drag": "added drag [1/s]",
    "nothing": "log ratio",
}


def indices(run: Run, **tags) -> list[int]:
    return [i for i, own in enumerate(run.trials) if tags.items() <= own._asdict().items()]


def whole(run: Run, i: int, name: str) -> np.ndarray:
    """A quantity of a flight from its beginning on."""
    return np.concatenate([getattr(run.before[run.trials[i].start], name), getattr(run.after, name)[i]])


@mpl.rc_context(STYLE)
def errors(run: Run, setup: Setup, reference: str) -> Figure:
    """Distance from the reference over time, the root mean square over seeds, a panel for each change."""
    changes = list(dict.fromkeys(trial.change for trial in run.trials))
    figure, panels = subplots((PAGE, 1.9 * -(-len(changes) // 2) + 0.9), -(-len(changes) // 2), 2, sharex=True)
    for panel, change in zip(panels.flat, changes, strict=False):
        for agent in dict.fromkeys(trial.agent for trial in run.trials):
            own = np.stack(
                [whole(run, i, "error") for i in indices(run, change=change, agent=agent, reference=reference)]
            )
            times = setup.period * (np.arange(own.shape[1]) + 1 - setup.periods)
            shown = times > -BEFORE
            rms = 100 * np.sqrt(np.mean(np.square(own), axis=0))
            width = 1.6 if agent in ("online", "oracle") else 1.0
            panel.plot(times[shown], rms[shown], color=COLOURS[agent], linewidth=width, label=AGENTS[agent])
        panel.axvline(0, color="0.7", linestyle=":", linewidth=1)
        panel.set(title=CHANGE_NAMES[change], yscale="log", ylabel="error [cm]")
        tick_errors(panel.yaxis, *panel.get_ylim())
    for panel in panels[-1]:
        panel.set_xlabel("time after the change [s]")
    return legend_below(figure, f"Distance from the reference, {REFERENCES[reference]}: RMS over seeds", columns=2)


@mpl.rc_context(STYLE)
def parameters(run: Run, setup: Setup, reference: str) -> Figure:
    """Estimates of one flight with their 95 % intervals, and the truth."""
    changes = list(dict.fromkeys(trial.change for trial in run.trials))
    figure, panels = subplots((PAGE, 1.9 * -(-len(changes) // 2) + 0.9), -(-len(changes) // 2), 2, sharex=True)
    for panel, change in zip(panels.flat, changes, strict=False):
        i = indices(run, change=change, agent="online", reference=reference, seed=0)[0]
        theta, std = whole(run, i, "theta"), whole(run, i, "std")
        times = setup.period * (np.arange(len(theta)) + 1 - setup.periods)
        shown = times > -BEFORE
        for (index, name), colour in zip(SHOWN[change], ("#0072B2", "#D55E00"), strict=False):
            middle, away = theta[shown, index], Z * std[shown, index]
            panel.plot(times[shown], middle, color=colour, linewidth=1.2)
            panel.fill_between(times[shown], middle - away, middle + away, color=colour, alpha=0.2, linewidth=0)
            truth = np.where(times[shown] < 0, 0.0, _truth(change, index))
            panel.plot(times[shown], truth, color=colour, linestyle="--", linewidth=1)
            place = 0.98, 0.05 if index == SHOWN[change][0][0] else 0.88
            panel.annotate(name, place, xycoords="axes fraction", color=colour, ha="right", fontsize=7)
        values = np.concatenate([theta[shown, index] for index, _ in SHOWN[change]])
        truths = [_truth(change, index) for index, _ in SHOWN[change]]
        low, high = min(values[-100:].min(), *truths, 0), max(values[-100:].max(), *truths, 0)
        room = 0.8 * (high - low) + 0.05
        panel.set(title=CHANGE_NAMES[change], ylabel=AXES[change], ylim=(low - room, high + room))
        panel.axvline(0, color="0.7", linestyle=":", linewidth=1)
    for panel in panels[-1]:
        panel.set_xlabel("time after the change [s]")
        panel.xaxis.set_major_locator(MaxNLocator(5))
    title = f"Seed 0, {REFERENCES[reference]}: estimates, 95 % intervals, truth (dashed; of wind its mean)"
    figure.suptitle(title, fontsize=9)
    return figure


def _truth(change: str, index: int) -> float:
    if index < PARTS:
        return float(true_theta(CHANGES[change])[index])
    return WIND_MEAN / IRIS.mass if change == "wind" else 0.0


def animate(path: Path, run: Run, setup: Setup, change: str, reference: str, wanted: Float[np.ndarray, "n 13"]) -> None:
    """An animated picture of the flights of seed 0 in real time: from above, and the error over time."""
    flights = {}
    for agent in ANIMATED:
        i = indices(run, change=change, agent=agent, reference=reference, seed=0)[0]
        flights[agent] = whole(run, i, "states")[:, POSITION], 100 * whole(run, i, "error")
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    above, beside = figure.subplots(1, 2, width_ratios=(1.3, 1))
    count = 2 * setup.periods
    above.plot(*wanted[:count, :2].T, color="0.7", linestyle="--", linewidth=1, label="reference")
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    top = max(error.max() for _, error in flights.values())
    beside.set(xlabel="time after the change [s]", ylabel="error [cm]", ylim=(0, 1.05 * top))
    beside.set_xlim(-CHANGE / 2, setup.periods * setup.period)
    beside.axvline(0, color="0.7", linestyle=":")
    drawn = []
    for agent, (place, error) in flights.items():
        (trail,) = above.plot([], [], color=COLOURS[agent], linewidth=1.4, label=AGENTS[agent])
        (vehicle,) = above.plot([], [], "o", color=COLOURS[agent])
        (line,) = beside.plot([], [], color=COLOURS[agent], linewidth=1.2)
        drawn.append((place, error, trail, vehicle, line))
    everywhere = np.concatenate([place[:, :2] for place, _ in flights.values()] + [wanted[:count, :2]])
    low, high = everywhere.min(axis=0) - 0.3, everywhere.max(axis=0) + 0.3
    above.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    figure.legend(loc="outside lower left", ncols=3, fontsize=7)

    def frame(i: int):
        t = (i - setup.periods) * setup.period
        figure.suptitle(f"{CHANGE_NAMES[change]}: {'before' if t < 0 else 'after'} the change, {t:+.1f} s")
        times = setup.period * (np.arange(i) + 1 - setup.periods)
        for place, error, trail, vehicle, line in drawn:
            here = place[: i // SHOWN_EVERY + 1, :2]
            trail.set_data(*here[-150:].T)
            vehicle.set_data(*here[-1:].T)
            line.set_data(times, error[:i])

    frames = range(max(0, setup.periods - round(CHANGE / 2 / setup.period)), count - 1, FRAME_EVERY)
    moving = FuncAnimation(figure, frame, frames=frames)  # pyright: ignore[reportArgumentType]
    moving.save(path, PillowWriter(fps=FRAMES_PER_SECOND))
