"""How do time and memory grow with seeds, with windows, with the horizon and with the width of the network?

Seeds and windows: one epoch on all devices, copies included. Horizon and width: one gradient step on 100 windows. The
slope is that of log time against log number between the two largest: 1 means that twice as much takes twice as long.
Memory is what a program needs besides its arguments; for seeds and windows, the arguments.
smoke: the network alone, two small numbers each. full: the hybrid, up to 1000 seeds, 1e6 windows, 1000 steps and 1024
hidden units, in some five minutes.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.subjects import BATCH, SETTINGS, Model, make_windows, training_run, training_runs
from benchmarks.timing import Call, Findings, compiled_with_memory, repeated, run, table
from hybrid_jax.sweep.lanes import LaneMap
from hybrid_jax.training import fitting
from hybrid_jax.training.fitting import gradient_step
from hybrid_jax.trajectories import Trajectories

VALIDATION = 100


@dataclass(frozen=True)
class Preset:
    """The numbers to measure at, each rising, and how long a call may be repeated."""

    model: Model
    seeds: tuple[int, ...]
    windows: tuple[int, ...]
    steps: tuple[int, ...]
    hidden: tuple[int, ...]
    turns: int  # repetitions of a call at the most
    budget: float  # seconds after which a call is repeated no more, beyond the third time


PRESETS = {
    "full": Preset(
        *("hybrid", (1, 10, 100, 1000), (1_000, 10_000, 100_000, 1_000_000)),
        *((10, 30, 100, 300, 1000), (16, 64, 256, 1024), 10, 10.0),
    ),
    "smoke": Preset("no_physics", (1, 2), (100, 200), (2, 4), (4, 8), turns=2, budget=1.0),
}
Case = tuple[Call, int]  # what is timed, and the bytes that it needs


def epoch_of(model: Model, seeds: int, windows: int) -> Case:
    """One epoch of so many lanes over so many windows each, as `hybrid_jax.sweep` runs it."""

    def epoch(lane, train, validation):
        state, plan = lane
        return fitting.run(state, plan, train, validation, SETTINGS, state.epoch + 1)[0]

    mapped, lanes = LaneMap(epoch), training_runs(model, seeds, windows)
    shared = many_windows(windows), many_windows(VALIDATION)
    held = sum(leaf.nbytes for leaf in jax.tree.leaves((lanes, shared)) if eqx.is_array(leaf))
    return lambda: mapped(lanes, shared, [1.0] * seeds, range(seeds)), held


def many_windows(count: int) -> Trajectories:
    """So many windows of 10 intervals; a thousand flown ones, over and over."""
    flown = make_windows(min(count, 1000), 10)
    return flown[np.arange(count) % len(flown)]


def step_of(model: Model, steps: int, hidden: int) -> Case:
    """One gradient step on windows of so many intervals, of a model with so many hidden units."""
    state, plan = training_run(model, BATCH, hidden)
    arguments = state.field, state.adam, plan, make_windows(BATCH, steps)
    call, _, needed = compiled_with_memory(partial(gradient_step, settings=SETTINGS), *arguments)
    return call, needed


AXES: dict[str, tuple[str, Callable[[Model, int], Case]]] = {
    "seeds": ("one epoch of 100 windows a seed", lambda model, seeds: epoch_of(model, seeds, BATCH)),
    "windows": ("one epoch of one seed", lambda model, windows: epoch_of(model, 1, windows)),
    "steps": ("one gradient step on 100 windows", lambda model, steps: step_of(model, steps, 64)),
    "hidden": ("one gradient step on 100 windows of 10 steps", lambda model, hidden: step_of(model, 10, hidden)),
}
LABELS = {"seeds": "seeds", "windows": "windows", "steps": "steps of horizon", "hidden": "hidden units"}


def measure_axis(axis: str, preset: Preset) -> list[dict[str, Any]]:
    """A row for each number along an axis, from the smallest, with the slope of time from the number before."""
    work, make = AXES[axis]
    rows: list[dict[str, Any]] = []
    for number in getattr(preset, axis):
        call, needed = make(preset.model, number)
        seconds = repeated(call, preset.turns, preset.budget)
        rows.append({"axis": axis, "work": work, "number": number, "seconds": seconds, "bytes": needed})
        rows[-1]["slope"] = slope(rows[-2], rows[-1]) if len(rows) > 1 else None
    return rows


def slope(before: dict[str, Any], after: dict[str, Any]) -> float:
    """d log seconds / d log number."""
    return math.log(after["seconds"] / before["seconds"]) / math.log(after["number"] / before["number"])


COLUMNS = {
    "": lambda row: row["work"],
    " ": lambda row: f"{row['number']:,} {LABELS[row['axis']]}",
    "s": lambda row: f"{row['seconds']:.4g}",
    "slope": lambda row: "" if row["slope"] is None else f"{row['slope']:.2f}",
    "MiB": lambda row: f"{row['bytes'] / 2**20:,.1f}",
}


def figure_of(rows: list[dict[str, Any]]) -> Figure:
    """Time against each number, with the slope of the last stretch and a line of slope 1."""
    figure, panels = plt.subplots(1, len(AXES), figsize=(13, 3.2), layout="constrained")
    for panel, axis in zip(panels, AXES, strict=True):
        points = [row for row in rows if row["axis"] == axis]
        numbers = np.array([row["number"] for row in points], float)
        seconds = np.array([row["seconds"] for row in points])
        panel.loglog(numbers, seconds, "o-", color="C0", label="measured")
        panel.loglog(numbers, seconds[-1] * numbers / numbers[-1], "--", color="0.6", label="slope 1")
        work = points[0]["work"].replace(" on ", "\non ").replace(" of ", "\nof ", 1)
        panel.set(xlabel=LABELS[axis], title=f"{work}\nslope at the end {points[-1]['slope']:.2f}")
        panel.title.set_fontsize("medium")
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("time [s]")
    panels[0].legend(frameon=False)
    return figure


def measure(preset: Preset) -> Findings:
    """Every axis in turn."""
    rows = [row for axis in AXES for row in measure_axis(axis, preset)]
    return Findings(rows, [table("growth", rows, COLUMNS)], figure=figure_of(rows))


if __name__ == "__main__":
    run("growth", __doc__, PRESETS, measure)
