"""How long does one gradient step take, against the same step written plainly, and against what the machine could do?

A step is 100 windows of 10 intervals: RK4, batch normalisation, regulariser, gradient, Adam, running statistics. The
plain one is one sample at a time under `vmap`, batch statistics by `pmean`, an RK4 by hand, derivatives by autodiff.
Both must agree, ours also with itself in double precision. The yardstick is a large float32 matrix product in the same
turns; it uses all cores, a step hardly more than one: set one core with taskset to compare the two. A user's own fields
have no form for a batch; they must not be slower than plain. Our own step is also timed without the kernels of
`hybrid_jax.native`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, get_args
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from benchmarks import plain
from benchmarks.operations import count_operations
from benchmarks.own_fields import OwnField, own_field, own_windows
from benchmarks.subjects import SETTINGS, Model, make_windows, training_run
from benchmarks.timing import Call, Findings, Ratio, Times, agree, compile_all, compiled, in_turns, run, table
from hybrid_jax import native
from hybrid_jax.dynamics.base import trainable
from hybrid_jax.dynamics.batching import batch_norms
from hybrid_jax.training.fitting import gradient_step, make_run_config, start
from hybrid_jax.training.objective import Settings

PRODUCT = "matrix product"  # beside the names of models
BARE = "without kernels"
# Sums of 100 windows × 40 evaluations in another order, in float32; and 1e-4 of a leaf's largest entry moves no rate.
AGREEMENT = 1e-4
# Of a step in single precision from the same in double: rounding at 6e-8 in 40 evaluations and sums of thousands.
ROUNDING = 1e-3


@dataclass(frozen=True)
class Preset:
    """Models, a user's own fields, windows and steps of a minibatch, the matrix product's size, and turns."""

    models: tuple[Model, ...]
    own_fields: tuple[OwnField, ...]
    windows: int
    steps: int
    product: int
    turns: int


PRESETS = {
    "full": Preset(("hybrid", "no_physics", "physics_only"), get_args(OwnField), 100, 10, product=2048, turns=40),
    "smoke": Preset(("hybrid",), ("mlp 64",), 100, 3, product=256, turns=2),
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
    operations: dict[str, int]


def prepare(model: Any, preset: Preset) -> Contest:
    """Both steps, compiled and compared: of a model at the start of pre-training, or of a user's own field."""
    count = preset.windows
    if model in preset.models:
        (state, plan), windows, settings = training_run(model, count), make_windows(count, preset.steps), SETTINGS
    else:
        state, windows = start(own_field(model), jax.random.key(0)), own_windows(model, count, preset.steps)
        plan, settings = make_run_config(1e-3, np.arange(count), count, 1, 1, 1, 0.0), Settings(batch_size=count)
    arguments, ours = (state.field, state.adam, plan, windows), partial(gradient_step, settings=settings)
    calls, seconds = compile_all({"ours": ours, "plain": plain.training_step}, *arguments)
    difference = compare(f"steps of {model}", calls["ours"](), calls["plain"]())
    if batch_norms(state.field) and native.prefix():
        calls[BARE], seconds[BARE] = without_kernels(ours, *arguments)
        compare(f"steps of {model} with and without kernels", calls["ours"](), calls[BARE]())
    exact = in_double_precision(ours, *arguments)
    rounding = compare(f"steps of {model} in single and double precision", calls["ours"](), exact, ROUNDING)
    return Contest(calls, seconds, difference, rounding, dict(count_operations(ours, *arguments)))


def without_kernels(function: Callable[..., PyTree], *arguments: PyTree) -> tuple[Call, float]:
    """`compiled`, by JAX alone."""
    jax.clear_caches()  # of what was traced with kernels
    with mock.patch.object(native, "prefix", return_value=None):
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
        "bare_over_ours": times.ratio((model, BARE), (model, "ours")) if BARE in contest.calls else None,
        "operations": contest.operations,
        "gflops": rate / 1e9,
        "matrix_product_gflops": roof / 1e9,
        "share_of_matrix_product": rate / roof,
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
ARITHMETIC = {
    "model": lambda row: row["model"],
    "Mflop a step": lambda row: f"{sum(row['operations'].values()) / 1e6:.1f}",
    "of it products": lambda row: f"{row['operations'].get('matrix', 0) / sum(row['operations'].values()):.0%}",
    "GFLOP/s": lambda row: f"{row['gflops']:.1f}",
    "roof": lambda row: f"{row['matrix_product_gflops']:.0f}",
    "share": lambda row: f"{row['share_of_matrix_product']:.0%}",
}


def measure(preset: Preset) -> Findings:
    """All models against their plain selves."""
    contests = {model: prepare(model, preset) for model in (*preset.models, *preset.own_fields)}
    matrix = np.random.default_rng(0).normal(size=(preset.product, preset.product)).astype(np.float32)
    calls: dict[Any, Call] = {PRODUCT: compiled(jnp.matmul, matrix, matrix)[0]}
    calls |= {(model, name): call for model, contest in contests.items() for name, call in contest.calls.items()}
    calls[PRODUCT]()
    times = in_turns(calls, preset.turns)
    rows = [row_of(model, contest, times, preset) for model, contest in contests.items()]
    ratios = [
        Ratio(
            f"{row['model']}: plain / ours", row["plain_over_ours"], at_least=1 if model in preset.models else 1 / 1.05
        )
        for model, row in zip(contests, rows, strict=True)
    ]
    ratios += [
        Ratio(f"{row['model']}: {BARE} / ours", row["bare_over_ours"], at_least=1.1)
        for row in rows
        if row["bare_over_ours"] is not None
    ]
    tables = [
        table("one gradient step", rows, STEP),
        table("arithmetic, estimated; roof: a matrix product", rows, ARITHMETIC),
    ]
    return Findings(rows, tables, ratios)


if __name__ == "__main__":
    run("training_step", __doc__, PRESETS, measure)
