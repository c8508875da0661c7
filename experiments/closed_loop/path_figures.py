"""Flights beside their reference: the path over the ground and the distance from it over time."""

import math
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure

from experiments.closed_loop.figures import TINTS, floored
from experiments.closed_loop.rows import REFERENCES, Flyer
from experiments.paper.figures import STYLE
from experiments.reporting.error_panels import tick_errors
from hybrid_jax.state import POSITION

States = Float[np.ndarray, "t 13"]
FURTHEST = 300.0  # cm: a flight that is lost is cut there
NEAREST = 0.02  # cm
ABOVE = [0, 1]  # x, y
VIEWS = {"low_pass": [0, 2]}  # x, z: its height is what matters


@mpl.rc_context(STYLE)
def paths(
    flights: Mapping[str, Mapping[Flyer, States]], references: Mapping[str, States], dt: float, title: str
) -> Figure:
    """A row for each reference: left from above, right the distance from the reference.

    Args:
        flights: reference → who flew → states every dt [s].
        references: the states wanted, at the same times.

    Raises:
        ValueError: no flights.
    """
    if not flights:
        raise ValueError("flights must not be empty: there is nothing to draw")
    figure = Figure(figsize=(9.5, 0.9 + 2.9 * len(flights)), layout="constrained")
    panels = figure.subplots(len(flights), 2, squeeze=False, width_ratios=(1, 1.25))
    nearest = math.inf
    for (above, beside), (reference, flown) in zip(panels, flights.items(), strict=True):
        wanted = references[reference][:, POSITION]
        seen = VIEWS.get(reference, ABOVE)
        above.plot(*wanted[:, seen].T, color="0.6", linestyle="--", linewidth=2.5, label="reference")
        for flyer, states in flown.items():
            place = states[:, POSITION]
            style = {"color": TINTS[flyer.model], "linestyle": _dash(flyer), "label": flyer.name}
            above.plot(*place[:, seen].T, linewidth=1.2, **style)
            error = 100 * np.linalg.norm(place - wanted, axis=1)
            nearest = np.fmin(nearest, np.nanmin(error))
            error = np.clip(error, NEAREST, FURTHEST)
            beside.plot(dt * np.arange(len(error)), error, linewidth=1.2, **style)
        _frame(above, wanted[:, seen], level=seen == ABOVE)
        side = "from above" if seen == ABOVE else "from the side"
        above.set(xlabel="x [m]", ylabel=f"{'xyz'[seen[1]]} [m]", title=f"{REFERENCES[reference]}: {side}")
        beside.set(yscale="log", xlabel="time [s]", ylabel="[cm]", title="distance from the reference (log scale)")
        tick_errors(beside.yaxis, *beside.get_ylim())
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    words = floored(nearest, NEAREST, " (")
    figure.suptitle(title + (f"{words})" if words else ""), fontsize=12)
    return figure


@mpl.rc_context(STYLE)
def strip(
    frames: Mapping[str, UInt8[np.ndarray, "k h w 3"]], times: Sequence[float], errors: Mapping[str, Sequence[float]],
    title: str,
) -> Figure:  # fmt: skip
    """Rendered frames, a row for each flight, a column for each time [s], under each its distance from the mark [m].

    Raises:
        ValueError: no flights.
    """
    if not frames:
        raise ValueError("frames must not be empty: there is nothing to draw")
    figure = Figure(figsize=(1.75 * len(times) + 0.6, 1.75 * len(frames) + 0.5), layout="constrained")
    panels = figure.subplots(len(frames), len(times), squeeze=False)
    for i, (row, (name, images)) in enumerate(zip(panels, frames.items(), strict=True)):
        for axes, image, t, error in zip(row, images, times, errors[name], strict=True):
            axes.imshow(image)
            axes.set(xticks=[], yticks=[], xlabel=f"{100 * error:.0f} cm off")
            axes.spines[:].set_visible(False)
            if i == 0:
                axes.set_title(f"{t:g} s")
        row[0].set_ylabel(name)
    figure.suptitle(title, fontsize=12)
    return figure


def _frame(axes, wanted: Float[np.ndarray, "t 2"], level: bool) -> None:
    """The view is the reference's, so that a lost flight does not shrink the others."""
    if not level:
        axes.set(xlim=(wanted[:, 0].min() - 0.5, wanted[:, 0].max() + 0.5), ylim=(0.0, 1.25 * wanted[:, 1].max()))
        return
    centre = (wanted.max(axis=0) + wanted.min(axis=0)) / 2
    half = max(0.6, 0.62 * np.ptp(wanted, axis=0).max())
    axes.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] - 0.6 * half, centre[1] + 0.6 * half))
    axes.set_aspect("equal")


def _dash(flyer: Flyer) -> str:
    return ":" if flyer.observer else "-" if flyer.n_train or flyer.model in ("nominal", "oracle") else "--"
