"""A model predictive controller for a multirotor: real-time Gauss–Newton on any vector field of the library.

It combines the real-time iteration (Diehl, Bock, Schlöder, "A real-time iteration scheme for nonlinear optimization in
optimal feedback control", 2005) and condensing (Bock and Plitt, "A multiple shooting algorithm for direct solution of
optimal control problems", 1984). Rotor speeds are a smooth function of unbounded variables, which enforces their
limits.
"""

import math
from dataclasses import dataclass, field
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.batches import solve
from hybrid_jax.control.cost import Scalar, Weights, deviations, input_rate_penalty, plan_cost, stage_factors
from hybrid_jax.control.sensitivities import advance_lagged, condensed
from hybrid_jax.dynamics.base import AbstractVectorField, as_field
from hybrid_jax.dynamics.batching import like
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.rotation import attitude_error
from hybrid_jax.vehicle import BODY_RATES, QUATERNION, STATE_SIZE, Input, State, Vehicle

VARIABLE_BOUND = 3.0  # there tanh is within 0.5 % of its limit, and its slope is still 1 %
# The line search varies the damping (Levenberg–Marquardt), not the length of a step: with a large initial rate, the
# Gauss–Newton step is often not a descent direction at any length.
DAMPING_FACTORS = (0.1, 1.0, 10.0)
FAILURE_FACTOR = 100.0  # on the damping, if none of them lowers the cost
INITIAL_DAMPING, MAX_DAMPING = 10.0, 1e8
# 1/s² and 1/s: the largest gains of the recovery that are stable with inputs held for 0.05 s.
ATTITUDE_GAIN, RATE_GAIN = 30.0, 10.0


class Plan(eqx.Module):
    """The state of the controller between calls.

    Attributes:
        variables: numbers (t, rotors) that tanh maps to the range of rotor speeds, constant in each interval.
        cost: cost predicted by the controller's model.
        damping: damping of the best Gauss–Newton step.
    """

    variables: Float[Array, "t rotors"]
    cost: Scalar
    damping: Scalar


_Point = tuple[Plan, Float[Array, "t 13"]]  # and the predicted states
_Start = tuple[State, Input]  # state and rotor speeds


def checked_states(
    name: str, x: State, reference: Float[Array, "n 13"], plan: Plan, steps: int | None = None, hidden: int = 0
) -> tuple[State, Float[Array, "n 13"], Plan]:
    """Check x, a reference and the plan and convert them to one dtype, which a loop's carry must keep."""
    x, reference = checks.floating(name, x), checks.floating("reference", reference)
    fits = reference.ndim == 2 and reference.shape[1] == STATE_SIZE and steps in (None, len(reference))
    if x.shape != (STATE_SIZE + hidden,) or not fits:
        expected = f"{name} ({STATE_SIZE + hidden},) and reference ({steps or 'n'}, 13)"
        raise ValueError(f"{expected} expected, got {x.shape} and {reference.shape}")
    checks.unit_quaternions(name, x, QUATERNION)
    checks.unit_quaternions("reference", reference, QUATERNION)
    dtype = jnp.result_type(*jax.tree.leaves((x, reference, plan)))
    return jax.tree.map(lambda leaf: leaf.astype(dtype), (x, reference, plan))


@dataclass(frozen=True)
class Controller:
    """A model predictive controller. It stores only settings: you pass a plan to each call, which returns the next.

    Attributes:
        vehicle: defines the limits and the initial guess (hover); the dynamics are the model that you pass to a call.
        weights: weights of the cost.
        steps: number of intervals of the horizon.
        interval: length of an interval [s], which is one step of RK4.
        period: time between two calls [s].
        iterations: number of Gauss–Newton steps in each call.
        damping: lower bound of the damping.
        min_speed: lower limit of the rotor speeds [rad/s]; the upper one is the vehicle's.
        rotor_lag: time constant of the rotors [s]; see `lagged_speeds`.

    Raises:
        ValueError: if an argument is invalid, or `interval` is not a multiple of `period`.
    """

    vehicle: Vehicle
    weights: Weights = field(default_factory=Weights)
    steps: int = 20
    interval: float = 0.05
    period: float = 0.01
    iterations: int = 1
    damping: float = 1e-3
    min_speed: float = 0.0
    rotor_lag: float = 0.0

    def __post_init__(self):
        for name, kind in (("vehicle", Vehicle), ("weights", Weights)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} must be a {kind.__name__}, got {checks.short_repr(getattr(self, name))}")
        checks.count("steps", self.steps, least=2)
        checks.count("iterations", self.iterations)
        for name in ("interval", "period", "damping"):
            checks.positive(name, getattr(self, name))
        checks.not_negative("min_speed", self.min_speed)
        checks.not_negative("rotor_lag", self.rotor_lag)
        if abs(self.stride * self.period - self.interval) > 1e-6 * self.interval:
            raise ValueError(f"interval must be a multiple of period {self.period}, got {self.interval}")
        low, hover, high = self.min_speed, self.vehicle.hover_speed, self.vehicle.max_rotor_speed
        if not low < hover < high:
            known = f"min_speed {low} and max_rotor_speed {high}"
            raise ValueError(f"vehicle: its hover speed {hover:.4g} must be between {known}")

    @property
    def stride(self) -> int:
        """The number of periods in an interval."""
        return max(round(self.interval / self.period), 1)

    def begin(self) -> Plan:
        """Return the plan for the first call: hover throughout."""
        middle, half = self._range()
        hover = math.atanh((self.vehicle.hover_speed - middle) / half)
        # With the dtype of later plans, since the second call would otherwise compile again.
        variables = jnp.full((self.steps, self.vehicle.rotors), hover, float)
        return Plan(variables, jnp.asarray(jnp.inf, float), jnp.asarray(INITIAL_DAMPING, float))

    def speeds(self, plan: Plan) -> Float[Array, "t rotors"]:
        """Return the rotor speeds [rad/s] of a plan, within the limits.

        Args:
            plan: a plan that a call returned.
        """
        return self._speeds(jnp.tanh(plan.variables))

    def horizon(self, reference: Float[Array, "n 13"], i: int | Scalar) -> Float[Array, "t 13"]:
        """Return the reference at the end of each interval of a call at sample i, from one sample per period.

        If i is traced, the last sample is repeated beyond the end.

        Args:
            reference: a state for each period (n, 13).
            i: index of the sample, from 0.

        Raises:
            ValueError: if i is not traced and negative, or its horizon ends after the reference.
        """
        checks.count("i", i, least=0)
        last = len(reference) - 1 - self.steps * self.stride
        if not checks.is_traced(i) and i > last:
            raise ValueError(f"reference must have {self.steps * self.stride} samples after i, so i ≤ {last}; got {i}")
        return reference[i + self.stride * jnp.arange(1, self.steps + 1)]

    def __call__(
        self,
        model: AbstractVectorField,
        reference: Float[Array, "t 13"],
        x: State,
        plan: Plan,
        speeds: Input | None = None,
    ) -> tuple[Input, Plan]:
        """Compute the rotor speeds [rad/s] to command for one period from state x, and the new plan.

        Args:
            x: the state (13,), followed by the hidden states of the model, if it has any.
            reference: the state to reach by the end of each interval (see `horizon`).
            plan: plan of the last call, or `begin()`.
            speeds: rotor speeds at state x [rad/s], by default the plan's commands; ignored without lag.

        Raises:
            ValueError: if shapes or types do not match or, unless traced, a number is not finite or a quaternion's
                norm is not 1. A compiled call normalises the quaternion of x.
        """
        if not callable(model):
            raise ValueError(f"model must be a vector field, got {checks.short_repr(model)}")
        if not isinstance(plan, Plan):
            raise ValueError(f"plan must be begin() or the plan of the last call, got {checks.short_repr(plan)}")
        if plan.variables.shape != (shape := (self.steps, self.vehicle.rotors)):
            raise ValueError(f"plan must have variables of shape {shape}, got {plan.variables.shape}")
        model = as_field(model).fuse_for_inference()
        x, reference, plan = checked_states("x", x, reference, plan, self.steps, as_field(model).hidden)
        x = RIGID_BODY_SPACE.canonical(x, RIGID_BODY_SPACE.normalise(x))
        start = x, (self.speeds(plan)[0] if speeds is None else speeds).astype(x.dtype)
        point = self._initial_guess(model, reference, start, plan)

        def iteration(_, point):
            return self._improve(model, reference, start, point)

        plan, _ = jax.lax.fori_loop(0, self.iterations, iteration, point)
        return self.speeds(plan)[0], plan

    def _range(self) -> tuple[float, float]:
        return (self.vehicle.max_rotor_speed + self.min_speed) / 2, (self.vehicle.max_rotor_speed - self.min_speed) / 2

    def _speeds(self, share: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
        middle, half = self._range()
        return middle + half * share

    def _initial_guess(self, model, reference, start: _Start, plan: Plan) -> _Point:
        """Choose the shifted plan or the attitude recovery by cost."""
        # The plan one period later, interpolated; the last interval is repeated.
        following = jnp.concatenate([plan.variables[1:], plan.variables[-1:]])
        shifted = plan.variables + (following - plan.variables) / self.stride

        def interval(both, inputs):
            wanted, held = inputs
            variables = jnp.stack([held, self._recovery(wanted, both[0][1])])
            both = jax.vmap(lambda start, variables: self._step(model, start, variables))(both, variables)
            return both, (both[0], variables)

        twice = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), start)
        both = jax.lax.scan(interval, twice, (reference, shifted))[1]
        states, variables = (jnp.swapaxes(leaf, 0, 1) for leaf in both)
        costs = jax.vmap(partial(plan_cost, self.weights, reference))(states, jnp.tanh(variables))
        best = jax.tree.map(lambda leaf: jnp.where(costs[1] < costs[0], leaf[1], leaf[0]), (variables, costs, states))
        return Plan(best[0], best[1], plan.damping), best[2]

    def _recovery(self, wanted: State, x: State) -> Float[Array, " rotors"]:
        """Return hover thrust with −30 φ − 10 (ω − ω_ref) [rad/s²], φ the attitude error, to end a planned roll."""
        vehicle, (middle, half) = self.vehicle, self._range()
        angle = attitude_error(wanted[QUATERNION], x[QUATERNION])
        acceleration = -ATTITUDE_GAIN * angle - RATE_GAIN * (x[BODY_RATES] - wanted[BODY_RATES])
        weight = jnp.asarray([vehicle.mass * vehicle.gravity], x.dtype)
        wrench = jnp.concatenate([weight, jnp.asarray(vehicle.inertia, x.dtype) * acceleration])
        rows = min(4, vehicle.rotors)  # three rotors do not affect yaw
        squares = jnp.asarray(np.linalg.pinv(vehicle.mixer[:rows]), x.dtype) @ wrench[:rows]
        share = (jnp.sqrt(jnp.maximum(squares, 0.0)) - middle) / half
        return jnp.arctanh(jnp.clip(share, -math.tanh(VARIABLE_BOUND), math.tanh(VARIABLE_BOUND)))

    def _step(self, model: AbstractVectorField, start: _Start, variables: Float[Array, " rotors"]) -> _Start:
        command = self._speeds(jnp.tanh(variables))
        return advance_lagged(model, *start, command, self.rotor_lag, self.interval)

    def _improve(self, model, reference, start: _Start, point: _Point) -> _Point:
        """Take the best damped Gauss–Newton step if it lowers the cost, and keep its damping."""
        plan, states = point
        path = jnp.concatenate([start[0][None], states])
        matrix, gradient = self._quadratic(model, reference, path, start[1], plan.variables)
        dampings = jnp.clip(plan.damping * jnp.array(DAMPING_FACTORS, gradient.dtype), self.damping, MAX_DAMPING)

        def interval(start, held):
            start = self._step(model, start, held)
            return start, start[0]

        def attempt(damping):
            step = solve(matrix + damping * jnp.eye(len(gradient), dtype=gradient.dtype), gradient)
            gain = step @ gradient + damping * step @ step  # decrease of the quadratic model
            variables = plan.variables - step.reshape(plan.variables.shape)
            variables = jnp.clip(variables, -VARIABLE_BOUND, VARIABLE_BOUND)
            states = jax.lax.scan(interval, like(start, damping), variables)[1]
            cost = plan_cost(self.weights, reference, states, jnp.tanh(variables))
            return (Plan(variables, jnp.where(jnp.isfinite(cost), cost, jnp.inf), damping), states), gain

        tried, gains = jax.vmap(attempt)(dampings)
        best = jax.tree.map(lambda leaf: leaf[jnp.argmin(tried[0].cost)], tried)
        kept = Plan(plan.variables, plan.cost, jnp.minimum(plan.damping * FAILURE_FACTOR, MAX_DAMPING)), states
        lower = best[0].cost < plan.cost
        best, states = jax.tree.map(lambda new, old: jnp.where(lower, new, old), best, kept)
        # At the optimum, rounding decides which step lowers the cost, so its damping is arbitrary.
        converged = gains[0] < jnp.finfo(gains.dtype).eps * (1 + plan.cost)
        return Plan(best.variables, best.cost, jnp.where(converged, INITIAL_DAMPING, best.damping)), states

    def _quadratic(self, model, reference, x: Float[Array, "t+1 13"], before: Input, variables):
        """Return JᵀJ and Jᵀr for the cost's residuals r and their Jacobian J in the decision variables."""
        factor = stage_factors(self.weights, self.steps)
        weighted = partial(deviations, self.weights)
        residual = jax.vmap(weighted)(reference, x[1:])
        jacobian = jax.vmap(jax.jacfwd(weighted, argnums=1))(reference, x[1:])
        share = jnp.tanh(variables)
        slope = 1 - jnp.square(share)  # of the tanh
        commands, to_speed = self._speeds(share), self._range()[1] * slope
        sensitivities = condensed(model, x[:-1], before, commands, self.rotor_lag, self.interval) * to_speed
        sensitivities = sensitivities.reshape(self.steps, -1, share.size)
        slopes = ((factor[:, None, None] * jacobian) @ sensitivities).reshape(-1, variables.size)
        changes = input_rate_penalty(self.weights, self.steps)
        gradient = slopes.T @ (factor[:, None] * residual).reshape(-1) + (slope * (changes @ share)).reshape(-1)
        between = changes[:, None, :, None] * jnp.eye(self.vehicle.rotors)[:, None, :] * slope[:, :, None, None] * slope
        return slopes.T @ slopes + between.reshape(variables.size, variables.size), gradient
