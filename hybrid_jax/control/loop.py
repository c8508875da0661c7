"""The closed loop: a plant, a controller with its prediction model and disturbance observer, and how well it flew."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax import checks
from hybrid_jax.control.controller import Controller, Plan, checked_states
from hybrid_jax.control.cost import Scalar, plan_cost
from hybrid_jax.control.sensitivities import advance
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import disturbed
from hybrid_jax.rotation import canonicalize_quaternion, heading
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY, Input, State

Plant = Callable[[State, Input, Scalar], State]  # the state one period after time t [s], u held

MOTION = slice(VELOCITY.start, BODY_RATES.stop)
SATURATION_MARGIN = 0.01  # share of its range from a limit, within which a rotor speed counts as saturated


class Flight(eqx.Module):
    """A closed-loop flight of t periods."""

    x: Float[Array, "*n t+1 13"]  # states, the initial one first
    u: Float[Array, "*n t 4"]  # rotor speeds held over each period, rad/s
    plans: Plan  # of the controller at each call
    disturbance: Float[Array, "*n t 6"]  # of the observer at each call, see `Estimate`


class Performance(eqx.Module):
    """Tracking performance of a flight."""

    position_rmse: Scalar  # m
    yaw_rmse: Scalar  # rad
    largest_error: Scalar  # of position, m
    crashed: Bool[Array, ""]  # below the ground, too far from the reference, or not finite
    saturation: Scalar  # share of the rotor speeds at a limit


class Estimate(eqx.Module):
    """State of the disturbance observer: a constant acceleration beyond the model, from one-step prediction errors.

    The discrete-time form of Chen, Yang, Guo and Li, "Disturbance-observer-based control and related methods", 2016:
    the prediction error divided by the period is the error of d, and a first-order filter of bandwidth β adds the share
    1 − exp(−β period) of it to d.
    """

    disturbance: Float[Array, "6"]  # d: acceleration [m/s², world] and angular acceleration [rad/s², body]
    expected: Float[Array, "6"]  # v [m/s] and ω [rad/s] predicted for the next sample

    @classmethod
    def begin(cls, x: State) -> "Estimate":
        """Zero disturbance at state x."""
        return cls(jnp.zeros_like(x, shape=6), x[MOTION])

    def correct(self, x: State, bandwidth: Scalar | float, period: float) -> "Estimate":
        """Update with the sample x; a bandwidth [rad/s] of 0 leaves the disturbance as it is."""
        error = (x[MOTION] - self.expected) / period
        return Estimate(self.disturbance - jnp.expm1(-bandwidth * period) * error, self.expected)

    def predict(self, field: AbstractVectorField, x: State, u: Input, period: float) -> "Estimate":
        """Predict the next sample with u held from x for one period [s]."""
        x = x.at[QUATERNION].set(canonicalize_quaternion(x[QUATERNION]))
        return Estimate(self.disturbance, advance(disturbed(field, self.disturbance), x, u, period)[MOTION])


def fly(
    plant: Plant,
    model: AbstractVectorField,
    reference: Float[Array, "n 13"],
    x0: State,
    controller: Controller,
    bandwidth: Scalar | float = 0.0,
) -> Flight:
    """Fly a plant along a reference for n − 1 − horizon periods.

    The function is pure: use it under `jit`, and under `vmap` over any argument. A crash does not stop a flight; one
    that diverges continues as infinity or NaN. `plans`, the largest part of the result, costs nothing if a compiled
    function does not return it.

    Args:
        plant: returns the state one period later.
        model: prediction model of the controller and of the observer.
        reference: one state per period (see `references.sample`).
        bandwidth: of the disturbance observer [rad/s]; 0 for none.

    Raises:
        ValueError: shapes do not fit, or the reference is no longer than the horizon; for concrete values also if one
            is not finite, a quaternion is not of length 1, or the bandwidth is negative.
    """
    checks.not_negative("bandwidth", bandwidth)
    x0, reference, plan = checked_states("x0", x0, reference, controller.begin())
    periods = len(reference) - 1 - controller.steps * controller.stride
    if periods < 1:
        raise ValueError(f"reference must be longer than the horizon, got {len(reference)} samples")

    def tick(carry, i):
        x, plan, estimate = carry
        estimate = estimate.correct(x, bandwidth, controller.period)
        corrected = disturbed(model, estimate.disturbance)
        u, plan = controller(corrected, controller.horizon(reference, i), x, plan)
        estimate = estimate.predict(model, x, u, controller.period)
        x = plant(x, u, i * controller.period).astype(x.dtype)
        return (x, plan, estimate), (x, u, plan, estimate.disturbance)

    start = (x0, plan, Estimate.begin(x0))
    _, (x, u, plans, disturbance) = jax.lax.scan(tick, start, jnp.arange(periods))
    return Flight(jnp.concatenate([x0[None], x]), u, plans, disturbance)


def performance(
    flight: Flight,
    reference: Float[Array, "n 13"],
    controller: Controller,
    ground: float = 0.0,
    crash_distance: float = 10.0,
) -> Performance:
    """Tracking performance after the initial state.

    Args:
        ground: altitude below which a flight counts as crashed [m].
        crash_distance: distance from the reference beyond which it does [m].
    """
    x, wanted = flight.x[1:], reference[1 : len(flight.x)]
    error = jnp.linalg.norm(x[:, POSITION] - wanted[:, POSITION], axis=-1)
    yaw_error = heading(x[:, QUATERNION]) - heading(wanted[:, QUATERNION])
    yaw_error = jnp.arctan2(jnp.sin(yaw_error), jnp.cos(yaw_error))
    sound = jnp.isfinite(x).all(axis=-1) & (x[:, POSITION.stop - 1] >= ground) & (error <= crash_distance)
    low, high = controller.min_speed, controller.vehicle.max_rotor_speed
    margin = SATURATION_MARGIN * (high - low)
    at_limit = (flight.u < low + margin) | (flight.u > high - margin)
    return Performance(
        jnp.sqrt(jnp.mean(jnp.square(error))),
        jnp.sqrt(jnp.mean(jnp.square(yaw_error))),
        error.max(),
        ~sound.all(),
        at_limit.mean(),
    )


class OpenLoopCosts(NamedTuple):
    """Costs of the plans of some calls of a flight. Plans that run to their end show the model's errors unhidden."""

    predicted: Float[Array, " c"]  # by the controller's model
    actual: Float[Array, " c"]  # of the same inputs in the plant


def open_loop_costs(
    plant: Plant, flight: Flight, reference: Float[Array, "n 13"], controller: Controller, calls: Sequence[int]
) -> OpenLoopCosts:
    """Predicted and actual open-loop cost of the plans of these calls."""

    def advance(x, inputs):
        x = plant(x, *inputs)
        return x, x

    def actual_cost(i: Scalar) -> Scalar:
        plan = jax.tree.map(lambda leaf: leaf[i], flight.plans)
        speeds = jnp.repeat(controller.speeds(plan), controller.stride, axis=0)
        times = controller.period * (i + jnp.arange(len(speeds)))
        states = jax.lax.scan(advance, flight.x[i], (speeds, times))[1][controller.stride - 1 :: controller.stride]
        return plan_cost(controller.weights, controller.horizon(reference, i), states, jnp.tanh(plan.variables))

    chosen = jnp.asarray(calls)
    return OpenLoopCosts(flight.plans.cost[chosen], jax.vmap(actual_cost)(chosen))


def relative_cost_error(costs: OpenLoopCosts, controller: Controller, distance: float = 0.005) -> Float[Array, ""]:
    """(actual − predicted) / predicted, each summed over the calls.

    The denominator is at least the cost of plans that stay `distance` [m] from the reference, because near zero the
    ratio means nothing; ValueError if it is not positive.
    """
    checks.positive("distance", distance)
    weights = controller.weights
    floor = (controller.steps - 1 + weights.terminal**2) * (weights.position * distance) ** 2
    error = jnp.sum(costs.actual) - jnp.sum(costs.predicted)
    return error / jnp.maximum(jnp.sum(costs.predicted), floor * len(costs.predicted))
