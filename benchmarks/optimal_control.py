"""Optimal control problems by the library's Gauss–Newton controller, by IPOPT and by fatrop, with models of every kind.

Six problems of 20 × 0.05 s, from a cold start, at most 40 iterations each, times of one core's processor time. The time
to 1 % is that until the inputs of an iterate, applied to the model, cost no more than 1.01 times the least cost that a
solver found. IPOPT and fatrop, both inside CasADi (extra `casadi`), start from the reference at hover speed.
"""

import time
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import hybrid_jax as hj
from benchmarks.control_problems import CONTROLLER, VEHICLE, Problem, adapted, flights, problems, trained
from benchmarks.shooting import Shooting, Solution
from benchmarks.timing import Findings, Ratio, run, table
from hybrid_jax.control import Controller, Plan, advance, figure_eight, fly, performance, sample
from hybrid_jax.dynamics import AbstractVectorField, ConstantDisturbance
from hybrid_jax.networks import smoothed

ITERATIONS = 40
NEAR = 1.01  # times the least cost
REPEATS = 3
SOLVERS = ("ours", "ipopt", "fatrop")
BETAS = (30.0, 5.0)


@dataclass(frozen=True)
class Preset:
    """What is solved."""

    epochs: int
    hidden: int
    problems: int  # how many of them
    kinds: tuple[str, ...]
    flight: float  # length of the closed loop [s]


KINDS = ("physics", "hybrid", "least squares", "invariant", "ReLU", *(f"ReLU, smooth {beta:g}" for beta in BETAS))
PRESETS = {
    "full": Preset(epochs=60, hidden=64, problems=6, kinds=KINDS, flight=3.0),
    "smoke": Preset(epochs=1, hidden=4, problems=1, kinds=("physics", "hybrid"), flight=0.05),
}


@dataclass(frozen=True)
class Solved:
    """How a solver did on a problem."""

    iterations: int  # until it stopped
    converged: bool
    cost: float  # of its inputs, applied to the model
    violation: float  # of constraints, at the end
    ms: float
    iterations_near: int | None  # until within 1 % of the least cost; None if it does not get there
    ms_near: float | None


def build(preset: Preset) -> dict[str, AbstractVectorField]:
    """The models by kind. All networks but those named for it have softplus in the place of ReLU."""
    hybrid, relu = (trained(name, preset.epochs, preset.hidden) for name in ("softplus", "relu"))
    made: dict[str, Callable[[], AbstractVectorField]] = {
        "physics": lambda: hj.rigid_body(hj.IRIS),
        "hybrid": lambda: hybrid,
        "least squares": lambda: adapted(hybrid),
        "invariant": lambda: trained(
            "softplus", preset.epochs, preset.hidden, inputs="no_xy_yaw", outputs="accelerations"
        ),
        "ReLU": lambda: relu,
        **{f"ReLU, smooth {beta:g}": partial(smoothed, relu, beta) for beta in BETAS},
    }
    return {kind: made[kind]() for kind in preset.kinds}


@eqx.filter_jit
def _plan(model: AbstractVectorField, wind: Array, reference: Array, x: Array, plan: Plan, iterations: Array) -> Plan:
    """The number of iterations is traced, so that all share one program."""
    return Controller(CONTROLLER.vehicle, iterations=iterations)(  # pyright: ignore[reportArgumentType]
        hj.Hybrid(model, ConstantDisturbance(wind)), reference, x, plan
    )[1]


def ours(model: AbstractVectorField, problem: Problem, iterations: int) -> Solution:
    """What the controller plans in so many iterations."""
    wind, reference, x0 = (jnp.asarray(part, jnp.float32) for part in (problem.wind, problem.reference, problem.x0))
    began = time.process_time()
    plan = _plan(model, wind, reference, x0, CONTROLLER.begin(), jnp.asarray(iterations))
    jax.block_until_ready(plan)
    seconds = time.process_time() - began
    return Solution(np.tanh(np.asarray(plan.variables, float)), float(plan.cost), 0.0, iterations, True, seconds)


def solve(model: AbstractVectorField, shooting: Shooting, problem: Problem) -> dict[str, Solved]:
    """Each solver's result, judged by the least cost of all."""
    calls = {name: partial(shooting.solve, name, problem) for name in SOLVERS[1:]}
    calls["ours"] = partial(ours, model, problem)
    ended = {name: calls[name](ITERATIONS) for name in SOLVERS}
    costs = {name: shooting.cost(problem, end.share) for name, end in ended.items()}
    enough = NEAR * min(costs.values())

    def solved(name: str, call: Callable[[int], Solution], end: Solution) -> Solved:
        near = None
        if costs[name] <= enough:
            # The fewest iterations by bisection, as costs fall from one to the next but for exceptions.
            near = 1 + bisect_left(range(1, ITERATIONS), True, key=lambda k: _cost(call(k)) <= enough)
        times = [None if k is None else 1e3 * min(call(k).seconds for _ in range(REPEATS)) for k in (ITERATIONS, near)]
        return Solved(end.iterations, end.converged, costs[name], end.violation, times[0] or 0.0, near, times[1])

    def _cost(one: Solution) -> float:
        return shooting.cost(problem, one.share)

    return {name: solved(name, calls[name], ended[name]) for name in SOLVERS}


def errors(model: AbstractVectorField, relu: AbstractVectorField, preset: Preset) -> dict[str, float]:
    """Of predictions over 0.1 s and in the closed loop, and the largest difference in ẋ from the network with ReLU."""
    windows = flights(VEHICLE, 300, seed=7)
    predicted = np.asarray(eqx.filter_jit(hj.rollout_batch)(model, windows.x0, windows.u, windows.dt))
    off = predicted - windows.x
    at = jnp.asarray(windows.x0), jnp.asarray(windows.u[:, 0])
    slopes = [jax.vmap(one)(*at) for one in (model, relu)]
    reference = sample(figure_eight(4.0), CONTROLLER, preset.flight)

    @eqx.filter_jit
    def flown(model):
        def plant(x, u, t):
            return advance(VEHICLE, x, u, CONTROLLER.period)

        return performance(fly(plant, model, reference, reference[0], CONTROLLER), reference, CONTROLLER)

    return {
        "largest": float(jnp.abs(slopes[0] - slopes[1]).max()),
        "velocity": float(np.sqrt(np.mean(np.square(off[..., 7:10])))),
        "rates": float(np.sqrt(np.mean(np.square(off[..., 10:])))),
        "closed_loop": float(flown(model).position_rmse),
    }


def _cell(solver: str) -> Callable[[dict[str, Any]], str]:
    def text(row):
        one = row["solvers"][solver]
        near = "–" if one["ms_near"] is None else f"{one['ms_near']:.1f} ({one['iterations_near']})"
        if solver == "ours":
            return near
        end = f"{one['ms']:.0f} ({one['iterations']})" if one["converged"] else "no"
        return f"{near}; {end}"

    return text


COLUMNS = {
    "model": lambda row: row["model"],
    "problem": lambda row: row["problem"],
    "ours, ms to 1 %": _cell("ours"),
    **{f"{name}, ms to 1 %; to the end": _cell(name) for name in SOLVERS[1:]},
    "cost / least": lambda row: ", ".join(f"{row['solvers'][name]['cost'] / row['least']:.4f}" for name in SOLVERS),
    "violation": lambda row: ", ".join(f"{row['solvers'][name]['violation']:.0e}" for name in SOLVERS),
}
OF_MODELS = {
    "model": lambda row: row["model"],
    "largest difference in ẋ": lambda row: f"{row['largest']:.2g}",
    "RMSE of v, 0.1 s [m/s]": lambda row: f"{row['velocity']:.4f}",
    "of ω [rad/s]": lambda row: f"{row['rates']:.4f}",
    "in the closed loop [m]": lambda row: f"{row['closed_loop']:.4f}",
}


def measure(preset: Preset) -> Findings:
    """Solve all, and look at what smoothing does to errors."""
    made = build(preset)
    rows, compared = [], []
    for kind, model in made.items():
        shooting = Shooting(model, CONTROLLER)
        for name, problem in list(problems().items())[: preset.problems]:
            found = solve(model, shooting, problem)
            least = min(one.cost for one in found.values())
            solved = {solver: asdict(one) for solver, one in found.items()}
            rows.append({"model": kind, "problem": name, "least": least, "solvers": solved})
        if kind.startswith(("ReLU", "hybrid")):
            compared.append({"model": kind} | errors(model, made.get("ReLU", model), preset))
    smooth = [row["solvers"] for row in rows if not row["model"].startswith("ReLU")]
    ratios = [
        Ratio(f"{name}: share that converges", float(np.mean([one[name]["converged"] for one in smooth])), at_least=1.0)
        for name in SOLVERS[1:]
    ]
    tables = [
        table("ms of processor time, iterations in brackets", rows, COLUMNS),
        table("what smoothing changes", compared, OF_MODELS),
    ]
    return Findings([*rows, {"errors": compared}], tables, ratios)


if __name__ == "__main__":
    run("optimal_control", __doc__, PRESETS, measure)
