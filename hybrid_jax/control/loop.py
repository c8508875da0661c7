"""The closed loop: a plant, a controller with its model, and what came of the flight."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax import checks
from hybrid_jax.control import observer
from hybrid_jax.control.attitude import heading
from hybrid_jax.control.controller import Controller, Plan, in_common
from hybrid_jax.control.cost import plan_cost
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import disturbed
from hybrid_jax.state import POSITION, QUATERNION, STATE_SIZE, Input, State

Scalar = Float[Array, ""]
Plant = Callable[[State, Input, Scalar], State]  # the state one period after time t [s], u held

NEAR = 0.01  # share of its range within which a rotor speed counts as saturated; the controller comes within 0.25 %


class Flight(eqx.Module):
    """A closed-loop flight of t periods.

    Attributes:
        x: states, from the start on.
        u: rotor speeds held over each period [rad/s].
        plans: the controller's plan at each call; their costs are what it promised.
        disturbance: what the observer took for it at each call, as in `observer.Estimate`.
    """

    x: Float[Array, "*n t+1 13"]
    u: Float[Array, "*n t 4"]
    plans: Plan
    disturbance: Float[Array, "*n t 6"]


class Performance(eqx.Module):
    """How well a flight followed its reference.

    Attributes:
        position_rmse: [m].
        yaw_rmse: [rad].
        largest_error: of position [m].
        crashed: it went below the ground, or further than `astray` from the reference, or became no number.
        saturation: share of the rotor speeds at a limit.
    """

    position_rmse: Scalar
    yaw_rmse: Scalar
    largest_error: Scalar
    crashed: Bool[Array, ""]
    saturation: Scalar


def fly(
    plant: Plant,
    model: AbstractVectorField,
    reference: Float[Array, "n 13"],
    x0: State,
    controller: Controller,
    bandwidth: Scalar | float = 0.0,
) -> Flight:
    """Fly a plant along a reference with a controller that believes in the model: n − 1 − horizon periods.

    Pure: jit it, and vmap it over lanes of plant, model, reference, start and bandwidth. Nothing stops at a crash, and
    a lane that diverges goes on as infinity or NaN. What of a flight is not returned from a compiled function costs
    nothing; `plans` is by far the largest part.

    Args:
        plant: function or module; the state one period later.
        reference: states wanted, every period (see `references.sample`).
        bandwidth: of the disturbance observer [rad/s]; 0 for none.

    Raises:
        ValueError: shapes that do not fit, a reference no longer than the horizon, or, where it is known, a number that
            is not finite, a quaternion that is none of a rotation or a bandwidth that is negative.
    """
    checks.not_negative("bandwidth", bandwidth)
    x0, reference = checks.floating("x0", x0), checks.floating("reference", reference)
    periods = _periods(reference, x0, controller)

    def tick(carry, i):
        x, plan, estimate = carry
        estimate = observer.correct(estimate, x, bandwidth, controller.period)
        believed = disturbed(model, estimate.disturbance)
        u, plan = controller(believed, controller.horizon(reference, i), x, plan)
        estimate = observer.predict(estimate, model, x, u, controller.period)
        x = plant(x, u, i * controller.period).astype(x.dtype)
        return (x, plan, estimate), (x, u, plan, estimate.disturbance)

    checks.unit_quaternions("x0", x0)
    checks.unit_quaternions("reference", reference)
    x0, reference, plan = in_common(x0, reference, controller.begin())
    start = (x0, plan, observer.begin(x0))
    _, (x, u, plans, disturbance) = jax.lax.scan(tick, start, jnp.arange(periods))
    return Flight(jnp.concatenate([x0[None], x]), u, plans, disturbance)


def performance(
    flight: Flight,
    reference: Float[Array, "n 13"],
    controller: Controller,
    ground: float = 0.0,
    astray: float = 10.0,
) -> Performance:
    """How well one flight followed its reference after its start; ground is an altitude, astray a distance [m]."""
    x, wanted = flight.x[1:], reference[1 : len(flight.x)]
    error = jnp.linalg.norm(x[:, POSITION] - wanted[:, POSITION], axis=-1)
    apart = heading(x[:, QUATERNION]) - heading(wanted[:, QUATERNION])
    apart = jnp.arctan2(jnp.sin(apart), jnp.cos(apart))
    sound = jnp.isfinite(x).all(axis=-1) & (x[:, POSITION.stop - 1] >= ground) & (error <= astray)
    low, high = controller.min_speed, controller.vehicle.max_rotor_speed
    at_limit = (flight.u < low + NEAR * (high - low)) | (flight.u > high - NEAR * (high - low))
    return Performance(
        jnp.sqrt(jnp.mean(jnp.square(error))),
        jnp.sqrt(jnp.mean(jnp.square(apart))),
        error.max(),
        ~sound.all(),
        at_limit.mean(),
    )


def realised(
    plant: Plant, flight: Flight, reference: Float[Array, "n 13"], controller: Controller, i: int | Scalar
) -> Scalar:
    """The cost of the plan of call i, rolled open loop in the plant; it promised `flight.plans.cost[i]`.

    This shows a model's errors where feedback hides them.
    """
    plan = jax.tree.map(lambda leaf: leaf[i], flight.plans)
    speeds = jnp.repeat(controller.speeds(plan), controller.stride, axis=0)
    times = controller.period * (i + jnp.arange(len(speeds)))

    def advance(x, held):
        x = plant(x, *held)
        return x, x

    states = jax.lax.scan(advance, flight.x[i], (speeds, times))[1][controller.stride - 1 :: controller.stride]
    return plan_cost(controller.weights, controller.horizon(reference, i), states, jnp.tanh(plan.free))


def _periods(reference: Float[Array, "n 13"], x0: State, controller: Controller) -> int:
    if x0.shape != (STATE_SIZE,) or reference.ndim != 2 or reference.shape[1] != STATE_SIZE:
        raise ValueError(f"x0 (13,) and reference (n, 13) expected, got {x0.shape} and {reference.shape}")
    periods = len(reference) - 1 - controller.steps * controller.stride
    if periods < 1:
        raise ValueError(f"reference must be longer than the horizon, got {len(reference)} samples")
    return periods
