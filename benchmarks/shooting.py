"""The controller's problem by multiple shooting in CasADi, for IPOPT and fatrop."""

import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from benchmarks.control_problems import Problem
from hybrid_jax.control import Controller, Weights
from hybrid_jax.control.controller import VARIABLE_BOUND
from hybrid_jax.dynamics import AbstractVectorField, ConstantDisturbance, Hybrid
from hybrid_jax.export import casadi_function
from hybrid_jax.vehicle import INPUT_SIZE, QUATERNION, STATE_SIZE

TOLERANCE = 1e-6
LIMIT = float(np.tanh(VARIABLE_BOUND))  # of the shares −1 … 1 of the range of rotor speeds, as in the controller
STAGE = STATE_SIZE + INPUT_SIZE  # a state, and the inputs before it, whose changes cost
OPTIONS: dict[str, dict[str, Any]] = {
    "ipopt": {"print_level": 0, "sb": "yes", "tol": TOLERANCE},
    "fatrop": {"print_level": 0, "tol": TOLERANCE},
}


@dataclass(frozen=True)
class Solution:
    """What a solver found."""

    share: Float[np.ndarray, "t 4"]
    cost: float
    violation: float  # the largest of the constraints
    iterations: int
    converged: bool
    seconds: float  # of processor time


class Shooting:
    """A model's problem, with variables x₀, s₀, x₁, s₁ … in the order that fatrop wants, and solvers of it."""

    def __init__(self, model: AbstractVectorField, controller: Controller):
        if controller.min_speed:
            raise ValueError(f"controller: min_speed must be 0, got {controller.min_speed}")
        self.controller, self._half = controller, controller.vehicle.max_rotor_speed / 2
        self._step, self._deviation = _step(model, controller.interval, self._half), _deviation(controller.weights)
        self._solver = lru_cache(maxsize=4)(self._new_solver)  # each holds its own second derivatives
        self._problem = self._multiple_shooting()

    def solve(self, solver: str, problem: Problem, iterations: int) -> Solution:
        """Start from hover speed and the reference, and stop after so many iterations."""
        call, steps = self._solver(solver, iterations), self.controller.steps
        inputs = np.full(INPUT_SIZE, self.controller.vehicle.hover_speed / self._half - 1)
        free = np.full(STAGE, np.inf)
        guess = np.concatenate([problem.x0, *(np.concatenate([inputs, inputs, x]) for x in problem.reference), inputs])
        bound = np.concatenate([free, *[np.full(INPUT_SIZE, LIMIT), free] * steps])
        parameters = np.concatenate([problem.x0, problem.wind, problem.reference.ravel()])
        began = time.process_time()
        found = call(x0=guess, lbx=-bound, ubx=bound, lbg=0, ubg=0, p=parameters)
        seconds, stats = time.process_time() - began, call.stats()
        share = np.asarray(found["x"]).ravel()[STAGE:].reshape(steps, -1)[:, :INPUT_SIZE]
        violation = float(np.abs(np.asarray(found["g"])).max())
        return Solution(share, float(found["f"]), violation, stats["iter_count"], stats["success"], seconds)

    def cost(self, problem: Problem, share: Float[np.ndarray, "t 4"]) -> float:
        """The cost of inputs, within their limits, and of the states that follow from them."""
        share = np.clip(share, -LIMIT, LIMIT)
        x, total = ca.DM(problem.x0), float(np.square(self.controller.weights.change * np.diff(share, axis=0)).sum())
        for k, held in enumerate(share):
            x = self._step(x, held, problem.wind)
            total += self._factor(k) * float(self._deviation(problem.reference[k], x))
        return total

    def _factor(self, k: int) -> float:
        return self.controller.weights.terminal**2 if k == self.controller.steps - 1 else 1.0

    def _multiple_shooting(self) -> dict[str, ca.MX]:
        steps = self.controller.steps
        x0, wind, reference = ca.MX.sym("x0", STATE_SIZE), ca.MX.sym("wind", 6), ca.MX.sym("r", STATE_SIZE, steps)
        x, before = ca.MX.sym("x_0", STATE_SIZE), ca.MX.sym("b_0", INPUT_SIZE)
        variables, gaps, cost = [x, before], [], 0
        begin = [x - x0, before]
        for k in range(steps):
            held = ca.MX.sym(f"s_{k}", INPUT_SIZE)
            after, kept = ca.MX.sym(f"x_{k + 1}", STATE_SIZE), ca.MX.sym(f"b_{k + 1}", INPUT_SIZE)
            gaps += [after - self._step(x, held, wind), kept - held, *begin]
            cost += self._factor(k) * self._deviation(reference[:, k], after)
            cost += ca.sumsqr(self.controller.weights.change * (held - before)) if k else 0
            variables += [held, after, kept]
            x, before, begin = after, kept, []
        parameters = ca.veccat(x0, wind, reference)
        return {"x": ca.vertcat(*variables), "f": cost, "g": ca.vertcat(*gaps), "p": parameters}  # pyright: ignore

    def _new_solver(self, name: str, iterations: int) -> ca.Function:
        options: dict[str, Any] = {"print_time": False, name: OPTIONS[name] | {"max_iter": iterations}}
        if name == "fatrop":
            options |= {"structure_detection": "auto", "equality": [True] * self._problem["g"].numel()}
        return ca.nlpsol("solver", name, self._problem, options)


def _step(model: AbstractVectorField, dt: float, half: float) -> ca.Function:
    """x⁺ from x, shares and a constant acceleration, with a quaternion of length 1."""

    def windy(x, both):
        return Hybrid(model, ConstantDisturbance(both[INPUT_SIZE:]))(x, both[:INPUT_SIZE])

    x, share, wind = ca.SX.sym("x", STATE_SIZE), ca.SX.sym("s", INPUT_SIZE), ca.SX.sym("w", 6)
    step = casadi_function(windy, dt, state_size=STATE_SIZE, input_size=INPUT_SIZE + 6)  # pyright: ignore
    end = step(x, ca.vertcat(half * (1 + share), wind))
    end[QUATERNION] = end[QUATERNION] / ca.norm_2(end[QUATERNION])
    return ca.Function("step", [x, share, wind], [end])


def _deviation(weights: Weights) -> ca.Function:
    """Σ (weight × deviation)² of a state from its reference, for attitude errors below π (see `cost.deviations`)."""
    reference, x = ca.SX.sym("r", STATE_SIZE), ca.SX.sym("x", STATE_SIZE)
    w, v, p, y = reference[3], reference[4:7], x[3], x[4:7]
    real, turn = w * p + ca.dot(v, y), w * y - p * v - ca.cross(v, y)
    real, turn = ca.if_else(real < 0, -real, real), ca.if_else(real < 0, -turn, turn)
    sine = ca.sqrt(ca.sumsqr(turn) + 1e-16)
    attitude = ca.DM([weights.tilt, weights.tilt, weights.yaw]) * 2 * ca.atan2(sine, real) / sine * turn
    away = x - reference
    parts = weights.position * away[:3], attitude, weights.velocity * away[7:10], weights.body_rates * away[10:]
    return ca.Function("deviation", [reference, x], [ca.sumsqr(ca.vertcat(*parts))])
