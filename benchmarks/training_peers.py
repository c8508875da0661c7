"""How long does a gradient step take, beside JAX alone, the paper's stack and PyTorch written for speed, on one core?

A step is 100 windows of 10 intervals: RK4, batch normalisation, regulariser, gradient, Adam, running statistics. Beside
ours: ours without the kernels of `hybrid_jax.kernels`; PyTorch with torchdiffeq, one interval after another; PyTorch
with an RK4 by hand; the same with its loss under `torch.compile`. All start from our parameters; loss, gradient and
running statistics must agree. torchdiffeq's rk4 is the 3/8 rule, so it is compared with our step by that rule. A turn
is steps in a row, as in training, and as many before that are not timed: in JAX in one compiled loop, in PyTorch in a
Python loop. Times are the processor's. The first call, in which PyTorch compiles, is apart. smoke: `torch.compile`
generates no code. full: some five minutes, most of it compiling.
"""

# PyTorch is of the extra `peers`.
# pyright: reportMissingImports=false

import os
import shutil
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Literal
from unittest import mock

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.markup import escape
from rich.table import Table

from benchmarks.subjects import SETTINGS, subject
from benchmarks.timing import Call, Findings, Options, Ratio, Times, agree, compiled, in_turns, run, stopwatch
from hybrid_jax.dynamics.base import trainable
from hybrid_jax.dynamics.rigid_body import LEARNED
from hybrid_jax.kernels import library
from hybrid_jax.training.fitting import gradient_step

PEERS = "pip install -e '.[peers]'"
# Errors of windows are a thousandth of their states: rounding these by 6e-8 changes a gradient by 1e-4. The car's is
# 2e-4 from double precision in JAX, and 3e-4 by its kernel. An error of 1e-3 of the largest entry moves no rate.
AGREEMENT = 1e-3
OURS, BARE = "ours", "ours without kernels"
TORCHDIFFEQ, BY_HAND, COMPILED = "PyTorch, torchdiffeq", "PyTorch by hand", "PyTorch, torch.compile"
RIVALS = TORCHDIFFEQ, BY_HAND, COMPILED
OF_TORCH = "paper", "vehicle"  # models that are written in PyTorch
REACH = {  # times our time
    "paper": {BARE: 1.1, TORCHDIFFEQ: 90.0, COMPILED: 15.0},
    "vehicle": {TORCHDIFFEQ: 40.0, COMPILED: 8.0},
    "pendulum": {BARE: 2.5},
    "car": {BARE: 2.5},
    "pde": {BARE: 1.0},
}


@dataclass(frozen=True)
class PeerOptions(Options):
    """Measure a gradient step of one model."""

    model: Literal["paper", "vehicle", "pendulum", "car", "pde"] = "paper"
    """Model to train. paper: rigid body, 64 units, batch norm. vehicle: with drag, 32 tanh units, no norm. Others: JAX
    only."""
    most_seconds: int = 900
    """A rival that takes more processor time to compile is skipped."""


@dataclass(frozen=True)
class Preset:
    """Windows and intervals of a minibatch, steps in a row, what generates code for `torch.compile`, and turns."""

    windows: int
    intervals: int
    in_a_row: int
    backend: str
    turns: int


PRESETS = {"full": Preset(100, 10, 20, "inductor", turns=10), "smoke": Preset(100, 2, 2, "aot_eager", turns=2)}


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


def skipped(rival: str, remedy: str = PEERS) -> dict[str, Any]:
    """The row of a rival that is not measured; `remedy` is what would change that."""
    return {"rival": rival, "skipped": f"skipped: {remedy}"}


def missing(preset: Preset, model: str) -> list[dict[str, Any]]:
    """A row for each rival that cannot be measured here."""
    if model not in OF_TORCH:
        return [skipped("PyTorch", f"{model} is not written in it")]
    if not find_spec("torch"):
        return [skipped(rival) for rival in RIVALS]
    compiler = os.environ.get("CXX", "g++")
    rows = [] if find_spec("torchdiffeq") else [skipped(TORCHDIFFEQ)]
    if preset.backend == "inductor" and shutil.which(compiler) is None:
        rows.append(skipped(COMPILED, f"the C++ compiler {compiler}, or another that CXX names"))
    return rows


def result_of(first: tuple) -> dict[str, Any]:
    """Loss, Adam's first moment and running statistics of a step of ours, named as in PyTorch where that has them.

    Not the parameters: Adam's first step is the gradient's sign, and at a gradient of zero that is rounding.
    """
    field, adam, value = first
    statistics = eqx.filter(field, jax.tree.map(lambda learned: not learned, trainable(field)))
    physics, network = adam.mu.physics, adam.mu.residual
    moment: Any = adam.mu
    if "k" in getattr(physics, "deviations", ()):
        moment = {f"network.{name}": getattr(network, name) for name in ("weight_in", "weight_out", "bias_out")}
        moment |= {f"network.{n}": getattr(network.norm, n) for n in ("gain", "shift") if hasattr(network.norm, n)}
        moment["physics.deviations"] = jnp.stack([physics.deviations[name] for name in LEARNED])
        if "drag" in physics.deviations:
            moment["physics.drag"] = physics.deviations["drag"]
    return joined(value, moment, jax.tree.leaves(eqx.filter(statistics, eqx.is_array)))


def joined(*parts: Any) -> dict[str, Any]:
    """Loss, Adam's first moment and statistics, each as one vector: in a single number a gradient may cancel."""
    vectors = (np.concatenate([np.zeros(0), *map(np.ravel, jax.tree.leaves(part))]) for part in parts)
    return dict(zip(("loss", "first_moment", "statistics"), vectors, strict=True))


def our_steps(step: Callable, arguments: tuple, in_a_row: int) -> Steps:
    """Steps of a program of JAX, in the loop of `training`."""

    def loop(field, adam, plan, windows):
        return jax.lax.fori_loop(0, in_a_row, lambda _, now: step(*now, plan, windows)[:2], (field, adam))

    call, seconds = compiled(loop, *arguments)
    return Steps(call, result_of(compiled(step, *arguments)[0]()), seconds)


@contextmanager
def without_kernels():
    """JAX alone."""
    jax.clear_caches()  # of what was traced with kernels
    with mock.patch.object(library, "obstacle", return_value="switched off"):
        yield
    jax.clear_caches()


def jax_steps(arguments: tuple, preset: Preset) -> dict[str, Steps]:
    """Ours, with kernels and without."""
    step, steps = partial(gradient_step, settings=SETTINGS), {}
    for name, context in {OURS: nullcontext, BARE: without_kernels}.items():
        with context():
            steps[name] = our_steps(step, arguments, preset.in_a_row)
    return steps


def rival_steps(arguments: tuple, preset: Preset, name: str) -> Steps:
    """A rival's first step from where we start too."""
    import torch

    from benchmarks import torch_rivals

    torch.set_num_threads(1)
    field, _, plan, windows = arguments
    integrate = torch_rivals.by_torchdiffeq if name == TORCHDIFFEQ else torch_rivals.by_hand
    backend, weight = preset.backend if name == COMPILED else None, float(plan.regulariser_weight)
    training = torch_rivals.Training(field, plan.rates, weight, windows, integrate, backend)
    value, seconds = stopwatch(training)

    def in_a_row() -> None:
        for _ in range(preset.in_a_row):
            training()

    return Steps(in_a_row, joined(*training.result(value).values()), seconds)


class TooLate(BaseException):
    """Not an Exception, which PyTorch's compiler would wrap in one of its own."""


@contextmanager
def at_most(seconds: int):
    """TooLate after so many seconds of processor time."""

    def stop(*_):
        raise TooLate

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds, 1)  # and again: what is raised in a callback of the collector is lost
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def prepare(preset: Preset, model: str, names: Sequence[str], most_seconds: int):
    """The steps of all programs, each warm, how far each is from ours, and rows of those that took too long."""
    arguments = subject(model, preset.windows, preset.intervals)
    steps, late = jax_steps(arguments, preset), []
    for name in names:
        try:
            with at_most(most_seconds):
                steps[name] = rival_steps(arguments, preset, name)
        except TooLate:
            late.append(skipped(name, f"not compiled in {most_seconds} s; --most-seconds allows more"))
    alike = {}
    if TORCHDIFFEQ in steps:
        step = partial(gradient_step, settings=replace(SETTINGS, solver=ThreeEighths()))
        alike[TORCHDIFFEQ] = result_of(compiled(step, *arguments)[0]())
    differences = {}
    for name in steps.keys() - {OURS}:
        what, own, other = f"steps of {name} and ours", alike.get(name, steps[OURS].result), steps[name].result
        whole, loss = (agree(what, *both, AGREEMENT) for both in ((own, other), (own["loss"], other["loss"])))
        differences[name] = {"difference": whole, "loss_difference": loss}
    for program in steps.values():
        program.call()
    return steps, differences, late


def row_of(name: str, steps: Steps, differences: dict[str, Any], times: Times, preset: Preset) -> dict[str, Any]:
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
        **differences.get(name, {"difference": None, "loss_difference": None}),
    }


def table_of(rows: list[dict[str, Any]], absent: list[dict[str, Any]], model: str) -> Table:
    heads = "", "ms", "windows/s", "× ours", r"compile \[s]", "differs by", "its loss by"
    table = Table(*heads, title=f"a gradient step of {model}, one core")
    for row in rows:
        speed = f"{1e3 * row['seconds']:.2f}", f"{row['windows_per_second']:,.0f}", f"{row['times_ours']:.2f}"
        off = ("" if row[key] is None else f"{row[key]:.0e}" for key in ("difference", "loss_difference"))
        table.add_row(row["program"], *speed, f"{row['compile_seconds']:.1f}", *off)
    for row in absent:
        table.add_row(row["rival"], *[""] * 5, escape(row["skipped"]))
    return table


def measure(preset: Preset, model: str, most_seconds: int) -> Findings:
    """Ours against every rival that is here."""
    absent = missing(preset, model)
    names = [one for one in RIVALS if model in OF_TORCH and one not in {row["rival"] for row in absent}]
    with TemporaryDirectory() as cache:
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = cache  # empty, so that compilation is timed
        programs, differences, late = prepare(preset, model, names, most_seconds)
        calls = {name: steps.call for name, steps in programs.items()}
        times = in_turns(calls, preset.turns, warm=True, clock=time.process_time)
    rows, absent = [row_of(name, one, differences, times, preset) for name, one in programs.items()], [*absent, *late]
    ratios = [
        Ratio(f"{row['program']} / ours", row["times_ours"], at_least=REACH[model].get(row["program"]))
        for row in rows
        if row["program"] != OURS
    ]
    return Findings([*rows, *absent], [table_of(rows, absent, model)], ratios)


if __name__ == "__main__":
    if hasattr(os, "sched_setaffinity"):  # core for core, with all threads from now on; the report says how many
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    run("training_peers", __doc__, PRESETS, measure, PeerOptions)
