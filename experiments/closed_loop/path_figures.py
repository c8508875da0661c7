"""Figures of single flights: the path, the distance from the reference over time, and rendered images."""

import math
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.closed_loop.claims import THREE
from experiments.closed_loop.figures import COLOURS_OF, floor_note
from experiments.closed_loop.flights import DRAW_EVERY, Flown
from experiments.closed_loop.results import DOMAINS, EXTERNAL_FORCE, KNOWN, Agent
from experiments.flying.images import FRAME_HEIGHT, FRAME_WIDTH, frames
from experiments.flying.scenario import PATHS, REFERENCES
from experiments.reporting.plots import STYLE, legend_below, subplots, tick_errors
from hybrid_jax.control import Controller, sample
from hybrid_jax.state import POSITION
from hybrid_jax.vehicle import IRIS

States = Float[np.ndarray, "t 13"]
Images = UInt8[np.ndarray, "k h w 3"]
LARGEST_ERROR, SMALLEST_ERROR = 300.0, 0.02  # cm: errors are clipped to these
DRAWN_TIMES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # s, of the strip
TOP_VIEW = [0, 1]  # x, y
VIEWS = {"low_pass": [0, 2]}  # x, z: the altitude matters


@mpl.rc_context(STYLE)
def paths(
    flights: Mapping[str, Mapping[Agent, States]], references: Mapping[str, States], dt: float, title: str
) -> Figure:
    """A row per reference: left the path, right the distance from it. Both are given as states every dt [s]."""
    if not flights:
        raise ValueError("flights must not be empty: there is nothing to draw")
    figure, panels = subplots((9.5, 0.9 + 2.9 * len(flights)), len(flights), 2, width_ratios=(1, 1.25))
    smallest = math.inf
    for (left, right), (reference, flown) in zip(panels, flights.items(), strict=True):
        wanted = references[reference][:, POSITION]
        view = VIEWS.get(reference, TOP_VIEW)
        left.plot(*wanted[:, view].T, color="0.6", linestyle="--", linewidth=2.5, label="reference")
        for agent, states in flown.items():
            dash = ":" if agent.observer else "-" if agent.n_train or agent.model in KNOWN else "--"
            style = {"color": COLOURS_OF[agent.model], "linestyle": dash, "label": agent.name}
            left.plot(*states[:, POSITION][:, view].T, linewidth=1.2, **style)
            error = 100 * np.linalg.norm(states[:, POSITION] - wanted, axis=1)
            smallest = np.fmin(smallest, np.nanmin(error))
            error = np.clip(error, SMALLEST_ERROR, LARGEST_ERROR)
            right.plot(dt * np.arange(len(error)), error, linewidth=1.2, **style)
        _frame(left, wanted[:, view], top=view == TOP_VIEW)
        side = "from above" if view == TOP_VIEW else "from the side"
        left.set(xlabel="x [m]", ylabel=f"{'xyz'[view[1]]} [m]", title=f"{REFERENCES[reference]}: {side}")
        right.set(yscale="log", xlabel="time [s]", ylabel="[cm]", title="distance from the reference (log scale)")
        tick_errors(right.yaxis, *right.get_ylim())
    return legend_below(figure, title + floor_note(smallest, SMALLEST_ERROR, " (", ")"))


@mpl.rc_context(STYLE)
def strip(flights: Mapping[str, tuple[Images, Sequence[float]]], times: Sequence[float], title: str) -> Figure:
    """A row per flight, of which images and the distance from the mark [m] in each are given; a column per time [s]."""
    figure, panels = subplots((1.75 * len(times) + 0.6, 1.75 * len(flights) + 0.5), len(flights), len(times))
    for row, (name, (images, errors)) in zip(panels, flights.items(), strict=True):
        for axes, image, error in zip(row, images, errors, strict=True):
            axes.imshow(image)
            axes.set(xticks=[], yticks=[], xlabel=f"{100 * error:.0f} cm off")
            axes.spines[:].set_visible(False)
        row[0].set_ylabel(name)
    for axes, t in zip(panels[0], times, strict=True):
        axes.set_title(f"{t:g} s")
    figure.suptitle(title, fontsize=12)
    return figure


def flown_paths(flown: Sequence[Flown], domain: str, agents: Sequence[Agent]) -> Figure:
    """`paths` of seed 0 at home."""
    own = {each.scenario.name: each for each in flown}
    at_home = {name: own[f"{domain} {name}"] for name in THREE if f"{domain} {name}" in own}
    flights = {name: {agent: each.states(agent) for agent in agents} for name, each in at_home.items()}
    controller = Controller(IRIS)
    dt = DRAW_EVERY * controller.period
    wanted = {}
    for name, states in flights.items():
        length = len(states[agents[0]])
        reference = sample(PATHS[name], controller, dt * (length - 1))
        wanted[name] = np.asarray(reference[: DRAW_EVERY * length : DRAW_EVERY])
    return paths(flights, wanted, dt, f"{DOMAINS[domain].capitalize()}: flights of one seed")


def rendered(flown: Sequence[Flown], few: int) -> Figure:
    """Rendered images of hover in the wind, before and after adaptation."""
    found = [each for each in flown if each.scenario.name == f"{EXTERNAL_FORCE} hover"]
    if not found:
        raise ValueError("nothing hovered in the wind")
    dt = DRAW_EVERY * Controller(IRIS).period
    mark = np.asarray(PATHS["hover"](jnp.zeros(()))[0])
    agents = (Agent("hybrid"), Agent("hybrid", few), Agent("invariant", few))
    states = np.stack([found[0].states(agent) for agent in agents])
    times = [t for t in DRAWN_TIMES if t < dt * states.shape[1]]
    shown = states[:, [round(t / dt) for t in times]]
    if not np.isfinite(shown).all():
        raise ValueError("a flight is not finite")
    images = frames(shown[..., :7].reshape(-1, 7), mark).reshape(*shown.shape[:2], FRAME_HEIGHT, FRAME_WIDTH, 3)
    errors = np.linalg.norm(shown[..., POSITION] - mark, axis=-1)
    pictures = {agent.name: (images[i], errors[i]) for i, agent in enumerate(agents)}
    return strip(pictures, times, "Hover in the wind: the red mark is the reference")


def _frame(axes: Axes, wanted: Float[np.ndarray, "t 2"], top: bool) -> None:
    """Limits from the reference, so that a flight that diverges does not shrink the others."""
    low, high = wanted.min(axis=0), wanted.max(axis=0)
    if not top:
        axes.set(xlim=(low[0] - 0.5, high[0] + 0.5), ylim=(0.0, 1.25 * high[1]))
        return
    (x, y), half = (low + high) / 2, max(0.6, 0.62 * (high - low).max())
    axes.set(xlim=(x - half, x + half), ylim=(y - 0.6 * half, y + 0.6 * half), aspect="equal")
