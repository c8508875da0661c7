"""A model predictive controller for a multirotor: real-time Gauss–Newton on any vector field of the library.

It follows the real-time iteration (Diehl, Bock, Schlöder, "A real-time iteration scheme for nonlinear optimization in
optimal feedback control", 2005): one Gauss–Newton step a call, from the last plan shifted by one period. Rotor speeds
are a smooth function of free numbers and so never leave their limits; the states are eliminated (condensing: Bock and
Plitt, "A multiple shooting algorithm for direct solution of optimal control problems", 1984).

The search for a step that lowers the cost goes along the damping, as Levenberg's and Marquardt's, and not along the
length of one step: after an upset a long Gauss–Newton step, cut to any of three lengths, is mostly no descent.
"""

import math
from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.control.attitude import one_sheet
from hybrid_jax.control.cost import Scalar, Weights, deviations, plan_cost, stage_factors, unrest
from hybrid_jax.control.sensitivities import advance, advanced
from hybrid_jax.control.steadying import steadying_speeds
from hybrid_jax.dynamics.base import AbstractVectorField, fuse_for_inference
from hybrid_jax.rotation import normalise
from hybrid_jax.state import INPUT_SIZE, QUATERNION, STATE_SIZE, Input, State
from hybrid_jax.vehicle import Vehicle

FREE = 3.0  # bound of the free numbers: tanh is within 0.5 % of its limit there, and its slope is still 1 %
FACTORS = (0.1, 1.0, 10.0)  # on the damping, that the line search tries
FAILED = 100.0  # factor on the damping when none of them lowered the cost
FIRST, MOST = 10.0, 1e8  # damping at the first call, and at most


class Plan(eqx.Module):
    """What the controller carries from one call to the next.

    Attributes:
        free: numbers whose tanh is the share of the rotor speeds' range, held over each interval of the horizon.
        cost: what the plan costs by the controller's model.
        damping: on the diagonal of the Gauss–Newton matrix, that did best.
    """

    free: Float[Array, "t 4"]
    cost: Scalar
    damping: Scalar


class _Point(eqx.Module):
    """A plan, the states that it leads to and what they cost."""

    free: Float[Array, "t 4"]
    states: Float[Array, "t 13"]
    cost: Scalar
    damping: Scalar


def in_common(x: State, reference: Float[Array, "n 13"], plan: Plan) -> tuple[State, Float[Array, "n 13"], Plan]:
    """The three in the type that holds the numbers of all: what is carried through a loop must not change its own."""
    dtype = jnp.result_type(*jax.tree.leaves((x, reference, plan)))
    return jax.tree.map(lambda leaf: leaf.astype(dtype), (x, reference, plan))


@dataclass(frozen=True)
class Controller:
    """Rotor speeds that let a model follow a reference; hyper-parameters only, the plan is passed in and returned.

    Attributes:
        vehicle: for the limits and the first guess, hover; the dynamics are those of the model that a call is given.
        weights: of the cost.
        steps: intervals of the horizon.
        interval: length of one [s]; one step of RK4.
        period: time between two calls [s].
        iterations: Gauss–Newton steps a call.
        damping: the least; the line search goes along it, from the Gauss–Newton step to a short one downhill.
        min_speed: lower limit of the rotor speeds [rad/s]; the upper one is the vehicle's.
        unit_quaternion: normalise the quaternion after each step of the prediction.

    Raises:
        ValueError: no vehicle or no weights, a number out of its range, or an interval that is no multiple of the
            period.
    """

    vehicle: Vehicle
    weights: Weights = field(default_factory=Weights)
    steps: int = 20
    interval: float = 0.05
    period: float = 0.01
    iterations: int = 1
    damping: float = 1e-3
    min_speed: float = 0.0
    unit_quaternion: bool = True

    def __post_init__(self):
        for name, kind in (("vehicle", Vehicle), ("weights", Weights)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} must be a {kind.__name__}, got {checks.short_repr(getattr(self, name))}")
        checks.count("steps", self.steps, least=2)
        checks.count("iterations", self.iterations)
        for name in ("interval", "period", "damping"):
            checks.positive(name, getattr(self, name))
        checks.not_negative("min_speed", self.min_speed)
        if abs(self.stride * self.period - self.interval) > 1e-6 * self.interval:
            raise ValueError(f"interval must be a multiple of period {self.period}, got {self.interval}")
        if not self.min_speed < self.vehicle.hover_speed < self.vehicle.max_rotor_speed:
            raise ValueError(
                f"vehicle: its hover speed {self.vehicle.hover_speed:.4g} must lie between min_speed {self.min_speed} "
                f"and max_rotor_speed {self.vehicle.max_rotor_speed}"
            )

    @property
    def stride(self) -> int:
        """Periods in an interval."""
        return max(round(self.interval / self.period), 1)

    def begin(self) -> Plan:
        """The plan before the first call: hover throughout."""
        middle, half = self._range()
        free = math.atanh((self.vehicle.hover_speed - middle) / half)
        # Of the type that later plans have, or a compiled call would be compiled twice.
        return Plan(
            jnp.full((self.steps, INPUT_SIZE), free, float), jnp.asarray(jnp.inf, float), jnp.asarray(FIRST, float)
        )

    def speeds(self, plan: Plan) -> Float[Array, "t 4"]:
        """The rotor speeds [rad/s] of a plan, between the limits."""
        return self._speeds(jnp.tanh(plan.free))

    def horizon(self, reference: Float[Array, "n 13"], i: int | Scalar) -> Float[Array, "t 13"]:
        """The reference at the end of each interval of a call at sample i, from one sampled every period.

        A compiled program cannot refuse an i whose horizon goes on beyond the reference: there the last sample stands
        for all that is missing, with the velocity that it has.

        Raises:
            ValueError: where i is known, one that is negative or whose horizon goes on beyond the reference.
        """
        checks.count("i", i, least=0)
        last = len(reference) - 1 - self.steps * self.stride
        if not checks.is_traced(i) and i > last:
            raise ValueError(f"reference must have {self.steps * self.stride} samples after i, so i ≤ {last}; got {i}")
        return reference[i + self.stride * jnp.arange(1, self.steps + 1)]

    def __call__(
        self, model: AbstractVectorField, reference: Float[Array, "t 13"], x: State, plan: Plan
    ) -> tuple[Input, Plan]:
        """Rotor speeds [rad/s] to be held for one period from state x, and the plan behind them.

        Args:
            reference: the state wanted at the end of each interval (see `horizon`).
            plan: that of the last call, or `begin()`.

        Raises:
            ValueError: no model, no plan of this horizon, shapes that do not fit, or, where it is known, a number that
                is not finite or a quaternion that is none of a rotation. A compiled call normalises that of x.
        """
        if not callable(model):
            raise ValueError(f"model must be a vector field, got {checks.short_repr(model)}")
        x, reference = checks.floating("x", x), checks.floating("reference", reference)
        if x.shape != (STATE_SIZE,) or reference.shape != (self.steps, STATE_SIZE):
            raise ValueError(f"x (13,) and reference ({self.steps}, 13) expected, got {x.shape} and {reference.shape}")
        self._check_plan(plan)
        checks.unit_quaternions("x", x)
        checks.unit_quaternions("reference", reference)
        x, reference, plan = in_common(x, reference, plan)
        x = x.at[QUATERNION].set(one_sheet(normalise(x[QUATERNION])))
        model = fuse_for_inference(model)
        free, states, cost = self._first(model, reference, x, plan)

        def iteration(_, point):
            return self._improve(model, reference, x, point)

        point = jax.lax.fori_loop(0, self.iterations, iteration, _Point(free, states, cost, plan.damping))
        plan = Plan(point.free, point.cost, point.damping)
        return self.speeds(plan)[0], plan

    def _check_plan(self, plan: Plan) -> None:
        if not isinstance(plan, Plan):
            raise ValueError(f"plan must be begin() or that of the last call, got {checks.short_repr(plan)}")
        if plan.free.shape != (self.steps, INPUT_SIZE):
            expected = f"{self.steps} intervals, as begin() has"
            raise ValueError(f"plan must be one of {expected}, got free numbers of shape {plan.free.shape}")

    def _range(self) -> tuple[float, float]:
        return (self.vehicle.max_rotor_speed + self.min_speed) / 2, (self.vehicle.max_rotor_speed - self.min_speed) / 2

    def _speeds(self, share: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
        middle, half = self._range()
        return middle + half * share

    def _shifted(self, free: Float[Array, "t 4"]) -> Float[Array, "t 4"]:
        """The plan one period on, between its values of now; the last one stays."""
        following = jnp.concatenate([free[1:], free[-1:]])
        return free + (following - free) / self.stride

    def _first(self, model, reference, x: State, plan: Plan):
        """What to improve on, its states and cost: the last plan shifted, or one that only steadies the vehicle."""

        def interval(x, given):
            wanted, shifted = given
            free = jnp.stack([shifted, self._steadying(wanted, x[1])])
            x = jax.vmap(lambda x, free: self._step(model, x, free))(x, free)
            return x, (x, free)

        both = jax.lax.scan(interval, jnp.stack([x, x]), (reference, self._shifted(plan.free)))[1]
        states, free = (jnp.swapaxes(leaf, 0, 1) for leaf in both)
        costs = jax.vmap(lambda states, free: self._cost(reference, states, free))(states, free)
        return jax.tree.map(lambda leaf: jnp.where(costs[1] < costs[0], leaf[1], leaf[0]), (free, states, costs))

    def _steadying(self, wanted: State, x: State) -> Float[Array, "4"]:
        """The free numbers that turn the vehicle to the attitude wanted."""
        middle, half = self._range()
        share = (steadying_speeds(self.vehicle, wanted, x) - middle) / half
        return jnp.arctanh(jnp.clip(share, -math.tanh(FREE), math.tanh(FREE)))

    def _step(self, model: AbstractVectorField, x: State, free: Float[Array, "4"]) -> State:
        return advance(model, x, self._speeds(jnp.tanh(free)), self.interval, self.unit_quaternion)

    def _predict(self, model, reference, x: State, free: Float[Array, "t 4"]) -> tuple[Float[Array, "t 13"], Scalar]:
        def interval(x, held):
            x = self._step(model, x, held)
            return x, x

        states = jax.lax.scan(interval, x, free)[1]
        return states, self._cost(reference, states, free)

    def _cost(self, reference, states: Float[Array, "t 13"], free: Float[Array, "t 4"]) -> Scalar:
        return plan_cost(self.weights, reference, states, jnp.tanh(free))

    def _improve(self, model, reference, x: State, point: "_Point") -> "_Point":
        """The best of the damped Gauss–Newton steps, if it lowers the cost; its damping is tried around next time."""
        matrix, gradient = self._quadratic(model, reference, jnp.concatenate([x[None], point.states]), point.free)
        dampings = jnp.clip(point.damping * jnp.array(FACTORS, gradient.dtype), self.damping, MOST)

        def attempt(damping):
            step = _solved(matrix + damping * jnp.eye(len(gradient), dtype=gradient.dtype), gradient)
            gain = step @ gradient + damping * step @ step  # what it lowers the quadratic model by
            free = jnp.clip(point.free - step.reshape(point.free.shape), -FREE, FREE)
            states, cost = self._predict(model, reference, x, free)
            return _Point(free, states, jnp.where(jnp.isfinite(cost), cost, jnp.inf), damping), gain

        tried, gains = jax.vmap(attempt)(dampings)
        best = jax.tree.map(lambda leaf: leaf[jnp.argmin(tried.cost)], tried)
        kept = eqx.tree_at(lambda p: p.damping, point, jnp.minimum(point.damping * FAILED, MOST))
        best = jax.tree.map(lambda new, old: jnp.where(best.cost < point.cost, new, old), best, kept)
        # At the best plan chance decides what lowers the cost: no damping did well there, and none is to be blamed.
        nothing = gains[0] < jnp.finfo(gains.dtype).eps * (1 + point.cost)
        return eqx.tree_at(lambda p: p.damping, best, jnp.where(nothing, FIRST, best.damping))

    def _quadratic(self, model, reference, x: Float[Array, "t+1 13"], free: Float[Array, "t 4"]):
        """JᵀJ and Jᵀr for the residuals r of the cost and their Jacobian J in the free numbers."""
        factor = stage_factors(self.weights, self.steps)
        residual, jacobian = jax.vmap(
            lambda wanted, found: _with_jacobian(lambda state: deviations(self.weights, wanted, state), found)
        )(reference, x[1:])
        size = free.size
        slopes = ((factor[:, None, None] * jacobian) @ self._sensitivities(model, x[:-1], free)).reshape(-1, size)
        share = jnp.tanh(free)
        slope = 1 - jnp.square(share)  # of the tanh
        changes = unrest(self.weights, self.steps)
        gradient = slopes.T @ (factor[:, None] * residual).reshape(-1) + (slope * (changes @ share)).reshape(-1)
        between = changes[:, None, :, None] * jnp.eye(INPUT_SIZE)[:, None, :] * slope[:, :, None, None] * slope
        return slopes.T @ slopes + between.reshape(size, size), gradient

    def _sensitivities(self, model, x: Float[Array, "t 13"], free: Float[Array, "t 4"]) -> Float[Array, "t 13 4*t"]:
        """∂(state at the end of each interval) / ∂(all free numbers)."""

        share = jnp.tanh(free)
        slope = self._range()[1] * (1 - jnp.square(share))  # of the rotor speeds in the free numbers

        def stage(x, u, slope):
            jacobian = advanced(model, x, u, self.interval, self.unit_quaternion)[1]
            return jnp.concatenate([jacobian[:, :STATE_SIZE], jacobian[:, STATE_SIZE:] * slope], axis=1)

        stages = jax.vmap(stage)(x, self._speeds(share), slope)

        def interval(carried, stage):
            jacobian, i = stage
            carried = jnp.tensordot(jacobian[:, :STATE_SIZE], carried, 1)
            carried = jax.lax.dynamic_update_slice(carried, jacobian[:, None, STATE_SIZE:], (0, i, 0))
            return carried, carried

        none = jnp.zeros((STATE_SIZE, self.steps, INPUT_SIZE), x.dtype)
        return jax.lax.scan(interval, none, (stages, jnp.arange(self.steps)))[1].reshape(self.steps, STATE_SIZE, -1)


@jax.custom_batching.sequential_vmap
def _solved(matrix: Float[Array, "n n"], vector: Float[Array, " n"]) -> Float[Array, " n"]:
    """matrix⁻¹ vector by Cholesky, one matrix after the other.

    On a CPU a batch of factorisations is shared out to the threads on which devices run as well; two devices that do so
    at once wait for each other for ever.
    """
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), vector)


def _with_jacobian(function, x):
    return function(x), jax.jacfwd(function)(x)
