"""How long does one gradient step take, against the same step written plainly, and against what the machine could do?

A step is 100 windows of 10 intervals: RK4, batch normalisation, regulariser, gradient, Adam, running statistics. Ours
is `training.gradient_step`. The plain one is what its mathematics reads like: one sample at a time under `vmap`, batch
statistics by `pmean` over its axis, an RK4 by hand, and every derivative by autodiff. Loss, gradient and running
statistics are compared before anything is timed, ours also with itself in double precision. The yardstick is a large
float32 matrix product in the same turns; it uses all cores that the process may use, a step hardly more than one: set
one core with taskset to compare the two.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from rich.table import Table

from benchmarks import plain
from benchmarks.operations import count_operations
from benchmarks.subjects import SETTINGS, Model, make_windows, training_run
from benchmarks.timing import Call, Findings, Ratio, Times, agree, compiled, in_turns, run
from hybrid_jax.dynamics.base import trainable
from hybrid_jax.training.fitting import gradient_step

PRODUCT = "matrix product"  # beside the names of models
# Sums of 100 windows × 40 evaluations in another order, in float32; and 1e-4 of a leaf's largest entry moves no rate.
AGREEMENT = 1e-4
# Of a step in single precision from the same in double: rounding at 6e-8 in 40 evaluations and sums of thousands.
ROUNDING = 1e-3


@dataclass(frozen=True)
class Preset:
    """Models, windows and steps of a minibatch, the matrix product's size, and turns."""

    models: tuple[Model, ...]
    windows: int
    steps: int
    product: int
    turns: int


PRESETS = {
    "full": Preset(("hybrid", "no_physics", "physics_only"), 100, 10, product=2048, turns=40),
    "smoke": Preset(("hybrid",), 100, 3, product=256, turns=2),
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


def matrix_product(size: int) -> Call:
    """A square float32 product of 2 size³ operations."""
    a = np.random.default_rng(0).normal(size=(size, size)).astype(np.float32)
    return compiled(jnp.matmul, a, a)[0]


@dataclass(frozen=True)
class Contest:
    """Our step and the plain one of one model, compiled, and found to agree."""

    calls: dict[str, Call]
    compile_seconds: dict[str, float]
    difference: float
    rounding: float
    operations: dict[str, int]


def prepare(model: Model, preset: Preset) -> Contest:
    """Both steps from the start of the protocol's pre-training."""
    state, plan = training_run(model, preset.windows)
    arguments = state.field, state.adam, plan, make_windows(preset.windows, preset.steps)
    ours = partial(gradient_step, settings=SETTINGS)
    programs = {"ours": compiled(ours, *arguments), "plain": compiled(plain.training_step, *arguments)}
    calls = {name: call for name, (call, _) in programs.items()}
    difference = compare(f"steps of {model}", calls["ours"](), calls["plain"]())
    seconds = {name: taken for name, (_, taken) in programs.items()}
    exact = in_double_precision(ours, *arguments)
    rounding = compare(f"steps of {model} in single and double precision", calls["ours"](), exact, ROUNDING)
    return Contest(calls, seconds, difference, rounding, dict(count_operations(ours, *arguments)))


def in_double_precision(function: Callable[..., PyTree], *arguments: PyTree) -> PyTree:
    """What a function of single-precision arguments comes to in double precision."""

    def double(leaf):
        return leaf.astype(np.float64) if eqx.is_inexact_array(leaf) else leaf

    with jax.enable_x64(True):
        return jax.device_get(jax.jit(function)(*jax.tree.map(double, jax.device_get(arguments))))


def time_all(contests: dict[str, Contest], preset: Preset) -> Times:
    """All steps of all models and the matrix product, in the same turns."""
    calls: dict[Any, Call] = {PRODUCT: matrix_product(preset.product)}
    calls |= {(model, name): call for model, contest in contests.items() for name, call in contest.calls.items()}
    calls[PRODUCT]()
    return in_turns(calls, preset.turns)


def row_of(model: str, contest: Contest, times: Times, preset: Preset) -> dict[str, Any]:
    """What is reported of a model."""
    seconds = {name: times.median((model, name)) for name in contest.calls}
    rate = sum(contest.operations.values()) / seconds["ours"]
    roof = 2 * preset.product**3 / times.median(PRODUCT)
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
        "operations": contest.operations,
        "gflops": rate / 1e9,
        "matrix_product_gflops": roof / 1e9,
        "share_of_matrix_product": rate / roof,
    }


def table_of(rows: list[dict[str, Any]]) -> Table:
    """The steps for reading."""
    heads = ("model", "ms", "windows/s", "plain [ms]", "plain / ours", "compile [s]", "differ by", "float32 error")
    table = Table(*heads, title="one gradient step")
    for row in rows:
        seconds, compiling = row["seconds"], row["compile_seconds"]
        table.add_row(
            row["model"],
            f"{1e3 * seconds['ours']:.2f}",
            f"{row['windows_per_second']:,.0f}",
            f"{1e3 * seconds['plain']:.2f}",
            f"{row['plain_over_ours']:.2f}",
            f"{compiling['ours']:.1f}",
            f"{row['difference']:.0e}",
            f"{row['float32_error']:.0e}",
        )
    return table


def roofline(rows: list[dict[str, Any]]) -> Table:
    """The rate of arithmetic for reading."""
    heads = ("model", "Mflop a step", "of it products", "GFLOP/s", "roof", "share")
    table = Table(*heads, title="arithmetic, estimated; roof: a matrix product")
    for row in rows:
        operations = row["operations"]
        total, matrix = sum(operations.values()), operations.get("matrix", 0)
        speeds = f"{row['gflops']:.1f}", f"{row['matrix_product_gflops']:.0f}", f"{row['share_of_matrix_product']:.0%}"
        table.add_row(row["model"], f"{total / 1e6:.1f}", f"{matrix / total:.0%}", *speeds)
    return table


def measure(preset: Preset) -> Findings:
    """All models against their plain selves."""
    contests = {model: prepare(model, preset) for model in preset.models}
    times = time_all(contests, preset)
    rows = [row_of(model, contest, times, preset) for model, contest in contests.items()]
    ratios = [Ratio(f"{row['model']}: plain / ours", row["plain_over_ours"], at_least=1.0) for row in rows]
    return Findings(rows, [table_of(rows), roofline(rows)], ratios)


if __name__ == "__main__":
    run("training_step", __doc__, PRESETS, measure)
