"""What does going through diffrax cost, against a hand-written scan?

Three programs predict the same windows with the same hybrid, RK4 and held inputs: `hybrid_jax.rollout` (diffrax solver
steps in a scan), a hand-written RK4 in a `lax.scan`, and one `diffrax.diffeqsolve` an interval. So do their gradients
with respect to the parameters. Then: how many windows of 1 s are predicted in a second, by `rollout_batch`, which works
on columns, and by `rollout` under `vmap`?
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from rich.table import Table

from benchmarks.plain import rk4
from benchmarks.subjects import DT, make_windows, untrained
from benchmarks.timing import Findings, Ratio, agree, compile_all, in_turns, run, table
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.integrate import RK4, rollout, rollout_batch
from hybrid_jax.trajectories import Trajectories

REACH = 1.05  # times the hand-written scan
# Float32 rounds at 6e-8, and each of up to 100 steps of ten operations may round otherwise; gradients add up windows.
AGREEMENT = {"prediction": 1e-4, "gradient": 1e-3}


@dataclass(frozen=True)
class Preset:
    """Windows, steps of each, what is done with them, and turns."""

    windows: int
    cases: tuple[tuple[str, int], ...]
    turns: int


PRESETS = {
    "full": Preset(1000, (("prediction", 10), ("prediction", 100), ("gradient", 10)), turns=30),
    "smoke": Preset(20, (("prediction", 10), ("gradient", 10)), turns=2),
}


def by_diffeqsolve(field: AbstractVectorField, x0, u):
    """One fixed step of `diffrax.diffeqsolve` an interval, as its documentation has it."""
    term = diffrax.ODETerm(lambda t, x, held: field(x, held))

    def interval(x, held):
        solution = diffrax.diffeqsolve(term, RK4(), 0.0, DT, dt0=DT, y0=x, args=held, max_steps=1)
        (x,) = jax.tree.leaves(solution.ys)[0]  # saved once, at the end
        return x, x

    return jax.lax.scan(interval, x0, u)[1]


INTEGRATORS: dict[str, Callable] = {
    "hybrid_jax": lambda field, x0, u: rollout(field, x0, u, DT),
    "by_hand": rk4,
    "diffeqsolve": by_diffeqsolve,
}


def prediction(integrate: Callable, field: AbstractVectorField, windows: Trajectories):
    return jax.vmap(partial(integrate, field))(windows.x0, windows.u)


def gradient(integrate: Callable, field: AbstractVectorField, windows: Trajectories):
    """Of the mean squared error of the prediction with respect to the field's parameters."""
    parameters, rest = eqx.partition(field, eqx.is_inexact_array)

    def error(parameters):
        predicted = prediction(integrate, eqx.combine(parameters, rest), windows)
        return jnp.mean(jnp.square(predicted - windows.x))

    return jax.grad(error)(parameters)


WORK = {"prediction": prediction, "gradient": gradient}


def measure_case(work: str, steps: int, preset: Preset) -> dict[str, Any]:
    arguments = untrained("hybrid"), make_windows(preset.windows, steps)
    calls, compiling = compile_all({name: partial(WORK[work], way) for name, way in INTEGRATORS.items()}, *arguments)
    hand = calls["by_hand"]()
    differences = {name: agree(f"{work}s of {name}", call(), hand, AGREEMENT[work]) for name, call in calls.items()}
    times = in_turns(calls, preset.turns)
    return {
        "work": work,
        "windows": preset.windows,
        "steps": steps,
        "difference": differences,
        "compile_seconds": compiling,
        "seconds": times.medians(),
        "times_by_hand": {name: times.ratio(name, "by_hand") for name in calls},
    }


def measure_forward(preset: Preset) -> dict[str, Any]:
    arguments = untrained("hybrid"), make_windows(preset.windows, 100)

    def columns(field, windows):
        return rollout_batch(field, windows.x0, windows.u, DT)

    ways = {"rollout_batch": columns, "rollout, vmapped": partial(prediction, INTEGRATORS["hybrid_jax"])}
    calls, _ = compile_all(ways, *arguments)
    agree("predictions as columns", calls["rollout_batch"](), calls["rollout, vmapped"](), AGREEMENT["prediction"])
    seconds = in_turns(calls, preset.turns).medians()
    speeds = {name: preset.windows / taken for name, taken in seconds.items()}
    return {"work": "forward", "windows": preset.windows, "steps": 100, "windows_per_second": speeds}


def table_of(rows: list[dict[str, Any]]) -> Table:
    heads = ("work", "steps", "integrator", "ms", "× by hand", "compile [s]", "differs by")
    made = Table(*heads, title="the same hybrid")
    for row in rows:
        for name, seconds in row["seconds"].items():
            ratio, compiling, difference = (row[k][name] for k in ("times_by_hand", "compile_seconds", "difference"))
            numbers = f"{1e3 * seconds:.2f}", f"{ratio:.3f}", f"{compiling:.1f}", f"{difference:.0e}"
            made.add_row(row["work"], str(row["steps"]), name, *numbers)
    return made


def measure(preset: Preset) -> Findings:
    """Every case, then the speed of prediction; the reach is asked of ours."""
    rows = [measure_case(work, steps, preset) for work, steps in preset.cases]
    forward = measure_forward(preset)
    columns = {"": lambda pair: pair[0], "windows/s": lambda pair: f"{pair[1]:,.0f}"}
    title = f"forward prediction of 1 s, {preset.windows} windows"
    speeds = table(title, [*forward["windows_per_second"].items()], columns)
    ratios = [
        Ratio(f"{row['work']}, {row['steps']} steps: {name} / by hand", row["times_by_hand"][name], at_most)
        for row in rows
        for name, at_most in (("hybrid_jax", REACH), ("diffeqsolve", None))
    ]
    return Findings([*rows, forward], [table_of(rows), speeds], ratios)


if __name__ == "__main__":
    run("rollout", __doc__, PRESETS, measure)
