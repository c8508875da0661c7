"""How long does a gradient step take, against the paper's stack and PyTorch written for speed, on one core?

The step is that of training_step.py. Rivals start from our parameters: PyTorch with torchdiffeq, one interval after
another; PyTorch with an RK4 by hand; the same with its loss under `torch.compile`. Loss, gradient and running
statistics must agree; torchdiffeq's rk4 is the 3/8 rule, so it is compared with our step by that rule. A turn is steps
in a row, as in training, and as many before that are not timed: ours in one compiled loop, the rivals in a Python loop.
The first call, in which PyTorch compiles, is apart. smoke: `torch.compile` generates no code. full: some five minutes,
most of it compiling.
"""

# PyTorch is of the extra `peers`.
# pyright: reportMissingImports=false

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from rich.markup import escape
from rich.table import Table

from benchmarks.peers import installed, keep_to_one_core, skipped
from benchmarks.subjects import SETTINGS, make_windows, training_run
from benchmarks.timing import Call, Findings, Ratio, Times, agree, compiled, in_turns, run, stopwatch
from benchmarks.training_step import AGREEMENT
from hybrid_jax.dynamics.rigid_body import LEARNED
from hybrid_jax.integrate import RK4
from hybrid_jax.training.fitting import gradient_step

OURS, TORCHDIFFEQ, BY_HAND, COMPILED = "ours", "PyTorch, torchdiffeq", "PyTorch by hand", "PyTorch, torch.compile"
RIVALS = TORCHDIFFEQ, BY_HAND, COMPILED
REACH = {TORCHDIFFEQ: 50.0, COMPILED: 8.0}  # times our time


@dataclass(frozen=True)
class Preset:
    """Windows and intervals of a minibatch, steps in a row, what generates code for `torch.compile`, and turns."""

    windows: int
    intervals: int
    in_a_row: int
    backend: str
    turns: int


PRESETS = {
    "full": Preset(100, 10, 20, "inductor", turns=10),
    "smoke": Preset(100, 2, 2, "aot_eager", turns=2),
}


class ThreeEighths(diffrax.AbstractERK):
    """The 3/8 rule, the other fourth-order method of Kutta (1901); fixed steps only."""

    tableau: ClassVar = diffrax.ButcherTableau(
        c=np.array([1 / 3, 2 / 3, 1.0]),
        b_sol=np.array([1.0, 3.0, 3.0, 1.0]) / 8,
        b_error=np.zeros(4),
        a_lower=(np.array([1 / 3]), np.array([-1 / 3, 1.0]), np.array([1.0, -1.0, 1.0])),
    )
    interpolation_cls: ClassVar = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        return 4


@dataclass(frozen=True)
class Steps:
    """One program."""

    call: Call  # makes steps in a row
    result: dict[str, Any]  # of a first step
    seconds: float  # of compiling; of PyTorch's first step, which compiles


def missing(preset: Preset) -> list[dict[str, Any]]:
    """A row for each rival that cannot be measured here."""
    if not installed("torch"):
        return [skipped(rival) for rival in RIVALS]
    compiler = os.environ.get("CXX", "g++")
    rows = [] if installed("torchdiffeq") else [skipped(TORCHDIFFEQ)]
    if preset.backend == "inductor" and shutil.which(compiler) is None:
        rows.append(skipped(COMPILED, f"the C++ compiler {compiler}, or another that CXX names"))
    return rows


def our_first(subject: tuple, solver: diffrax.AbstractSolver) -> dict[str, Any]:
    """The result of our first step by some integrator."""
    step = partial(gradient_step, settings=replace(SETTINGS, solver=solver))
    field, adam, value = compiled(step, *subject)[0]()
    physics, network, running = adam.mu.physics, adam.mu.residual, field.residual.norm.running
    moment = {f"network.{name}": getattr(network, name) for name in ("weight_in", "weight_out", "bias_out")}
    moment |= {f"network.{name}": getattr(network.norm, name) for name in ("gain", "shift")}
    moment["physics.deviations"] = jnp.stack([physics.deviations[name] for name in LEARNED])
    return {"loss": value, "first_moment": moment, "mean": running.mean, "variance": running.variance}


def our_steps(subject: tuple, in_a_row: int) -> Steps:
    """Ours, in the loop of `training`."""
    step = partial(gradient_step, settings=SETTINGS)

    def loop(field, adam, plan, windows):
        def body(_, learner):
            field, adam = learner
            return step(field, adam, plan, windows)[:2]

        return jax.lax.fori_loop(0, in_a_row, body, (field, adam))

    call, seconds = compiled(loop, *subject)
    return Steps(call, our_first(subject, RK4()), seconds)


def rival_steps(subject: tuple, preset: Preset, names: Sequence[str]) -> dict[str, Steps]:
    """The rivals' first steps from where we start too."""
    import torch

    from benchmarks import torch_rivals

    torch.set_num_threads(1)
    field, _, plan, windows = subject

    def in_a_row(step: Call) -> None:
        for _ in range(preset.in_a_row):
            step()

    steps = {}
    for name in names:
        integrate = torch_rivals.by_torchdiffeq if name == TORCHDIFFEQ else torch_rivals.by_hand
        backend = preset.backend if name == COMPILED else None
        training = torch_rivals.Training(field, plan.rates, float(plan.regulariser_weight), windows, integrate, backend)
        value, seconds = stopwatch(training)
        steps[name] = Steps(partial(in_a_row, training), training.result(value), seconds)
    return steps


def prepare(preset: Preset, names: Sequence[str]) -> tuple[dict[str, Steps], dict[str, float]]:
    """Our steps and those of the rivals that are named, each warm, and by how much each rival differs from ours."""
    state, plan = training_run("hybrid", preset.windows)
    subject = state.field, state.adam, plan, make_windows(preset.windows, preset.intervals)
    ours = our_steps(subject, preset.in_a_row)
    rivals = rival_steps(subject, preset, names) if names else {}
    alike = {TORCHDIFFEQ: our_first(subject, ThreeEighths())} if TORCHDIFFEQ in names else {}
    differences = {
        name: agree(f"steps of {name} and ours", alike.get(name, ours.result), rival.result, AGREEMENT)
        for name, rival in rivals.items()
    }
    steps = {OURS: ours, **rivals}
    for program in steps.values():
        program.call()
    return steps, differences


def row_of(name: str, steps: Steps, differences: dict[str, float], times: Times, preset: Preset) -> dict[str, Any]:
    seconds = times.median(name) / preset.in_a_row
    return {
        "program": name,
        "windows": preset.windows,
        "intervals": preset.intervals,
        "steps_in_a_row": preset.in_a_row,
        "seconds": seconds,
        "windows_per_second": preset.windows / seconds,
        "times_ours": times.ratio(name, OURS),
        "compile_seconds": steps.seconds,
        "difference": differences.get(name),
    }


def table_of(rows: list[dict[str, Any]], absent: list[dict[str, Any]]) -> Table:
    table = Table("", "ms", "windows/s", "× ours", r"compile \[s]", "differs by", title="a gradient step, one core")
    for row in rows:
        speed = f"{1e3 * row['seconds']:.2f}", f"{row['windows_per_second']:,.0f}", f"{row['times_ours']:.2f}"
        difference = "" if row["difference"] is None else f"{row['difference']:.0e}"
        table.add_row(row["program"], *speed, f"{row['compile_seconds']:.1f}", difference)
    for row in absent:
        table.add_row(row["rival"], *[""] * 4, escape(row["skipped"]))
    return table


def measure(preset: Preset) -> Findings:
    """Ours against every rival that is here."""
    absent = missing(preset)
    names = [rival for rival in RIVALS if rival not in {row["rival"] for row in absent}]
    with TemporaryDirectory() as cache:
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = cache  # empty, so that compilation is timed
        programs, differences = prepare(preset, names)
        times = in_turns({name: steps.call for name, steps in programs.items()}, preset.turns, warm=True)
    rows = [row_of(name, steps, differences, times, preset) for name, steps in programs.items()]
    ratios = [
        Ratio(f"{row['program']} / ours, one core", row["times_ours"], at_least=REACH.get(row["program"]))
        for row in rows
        if row["program"] != OURS
    ]
    return Findings([*rows, *absent], [table_of(rows, absent)], ratios)


if __name__ == "__main__":
    keep_to_one_core()
    run("training_peers", __doc__, PRESETS, measure)
