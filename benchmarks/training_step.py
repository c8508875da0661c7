"""How long does one gradient step take, against the same step written plainly?

A step is 100 windows of 10 intervals: RK4, batch normalisation, regulariser, gradient, Adam, running statistics. The
plain one is one sample at a time under `vmap`, batch statistics by `pmean`, an RK4 by hand, derivatives by autodiff.
Both must agree, ours also with itself in double precision. Our own step is also timed without the
kernels of `hybrid_jax.kernels`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest import mock

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from benchmarks import plain
from benchmarks.subjects import SETTINGS, Model, make_windows, training_run
from benchmarks.timing import Call, Findings, Ratio, Times, agree, compile_all, compiled, in_turns, run, table
from hybrid_jax.dynamics.base import trainable
from hybrid_jax.kernels import library
from hybrid_jax.training.fitting import gradient_step

BARE = "without kernels"
# Sums of 100 windows × 40 evaluations in another order, in float32; and 1e-4 of a leaf's largest entry moves no rate.
AGREEMENT = 1e-4
# Of a step in single precision from the same in double: rounding at 6e-8 in 40 evaluations and sums of thousands.
ROUNDING = 1e-3


@dataclass(frozen=True)
class Preset:
    """Models, windows and steps of a minibatch, and turns."""

    models: tuple[Model, ...]
    windows: int
    steps: int
    turns: int


PRESETS = {
    "full": Preset(("hybrid", "no_physics", "physics_only"), 100, 10, turns=40),
    "smoke": Preset(("hybrid", "physics_only"), 100, 3, turns=2),
}


def compare(what: str, ours, theirs, tolerance: float = AGREEMENT) -> float:
    """The largest difference in loss, running statistics, and gradient, which is ten times Adam's first moment.

    Not the parameters: Adam's first step is the gradient's sign, and at a gradient of zero that is rounding.
    """

    def comparable(result):
        field, adam, value = result
        statistics = eqx.filter(field, jax.tree.map(lambda learned: not learned, trainable(field)))
        return value, adam.mu, eqx.filter(statistics, eqx.is_array)

    return agree(what, comparable(ours), comparable(theirs), tolerance)


@dataclass(frozen=True)
class Contest:
    """Our step and the plain one of one model, compiled, and found to agree."""

    calls: dict[str, Call]
    compile_seconds: dict[str, float]
    difference: float
    rounding: float


def prepare(model: Model, preset: Preset) -> Contest:
    """Both steps, compiled and compared: of a model at the start of pre-training."""
    count = preset.windows
    (state, plan), windows, settings = training_run(model, count), make_windows(count, preset.steps), SETTINGS
    arguments, ours = (state.field, state.adam, plan, windows), partial(gradient_step, settings=settings)
    calls, seconds = compile_all({"ours": ours, "plain": plain.training_step}, *arguments)
    difference = compare(f"steps of {model}", calls["ours"](), calls["plain"]())
    if library.obstacle() is None:
        calls[BARE], seconds[BARE] = without_kernels(ours, *arguments)
        compare(f"steps of {model} with and without kernels", calls["ours"](), calls[BARE]())
    exact = in_double_precision(ours, *arguments)
    rounding = compare(f"steps of {model} in single and double precision", calls["ours"](), exact, ROUNDING)
    return Contest(calls, seconds, difference, rounding)


def without_kernels(function: Callable[..., PyTree], *arguments: PyTree) -> tuple[Call, float]:
    """`compiled`, by JAX alone."""
    jax.clear_caches()  # of what was traced with kernels
    with mock.patch.object(library, "obstacle", return_value="switched off"):
        found = compiled(function, *arguments)
    jax.clear_caches()
    return found


def in_double_precision(function: Callable[..., PyTree], *arguments: PyTree) -> PyTree:
    """What a function of single-precision arguments comes to in double precision."""

    def double(leaf):
        return leaf.astype(np.float64) if eqx.is_inexact_array(leaf) else leaf

    with jax.enable_x64(True):
        return jax.device_get(jax.jit(function)(*jax.tree.map(double, jax.device_get(arguments))))


def row_of(model: str, contest: Contest, times: Times, preset: Preset) -> dict[str, Any]:
    """What is reported of a model."""
    seconds = {name: times.median((model, name)) for name in contest.calls}
    return {
        "model": model,
        "windows": preset.windows,
        "steps": preset.steps,
        "difference": contest.difference,
        "float32_error": contest.rounding,
        "compile_seconds": contest.compile_seconds,
        "seconds": seconds,
        "windows_per_second": preset.windows / seconds["ours"],
        "plain_over_ours": times.ratio((model, "plain"), (model, "ours")),
        "bare_over_ours": times.ratio((model, BARE), (model, "ours")) if BARE in contest.calls else None,
    }


STEP = {
    "model": lambda row: row["model"],
    "ms": lambda row: f"{1e3 * row['seconds']['ours']:.2f}",
    "windows/s": lambda row: f"{row['windows_per_second']:,.0f}",
    "plain [ms]": lambda row: f"{1e3 * row['seconds']['plain']:.2f}",
    "plain / ours": lambda row: f"{row['plain_over_ours']:.2f}",
    BARE: lambda row: "" if row["bare_over_ours"] is None else f"{row['bare_over_ours']:.2f}",
    "compile [s]": lambda row: f"{row['compile_seconds']['ours']:.1f}",
    "differ by": lambda row: f"{row['difference']:.0e}",
    "float32 error": lambda row: f"{row['float32_error']:.0e}",
}


def measure(preset: Preset) -> Findings:
    """All models against their plain selves."""
    contests = {model: prepare(model, preset) for model in preset.models}
    calls: dict[Any, Call] = {
        (model, name): call for model, contest in contests.items() for name, call in contest.calls.items()
    }
    times = in_turns(calls, preset.turns)
    rows = [row_of(model, contest, times, preset) for model, contest in contests.items()]
    ratios = [Ratio(f"{row['model']}: plain / ours", row["plain_over_ours"], at_least=1) for row in rows]
    ratios += [
        Ratio(f"{row['model']}: {BARE} / ours", row["bare_over_ours"], at_least=1.1)
        for row in rows
        if row["bare_over_ours"] is not None
    ]
    return Findings(rows, [table("one gradient step", rows, STEP)], ratios)


if __name__ == "__main__":
    run("training_step", __doc__, PRESETS, measure)
