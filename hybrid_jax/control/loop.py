"""The closed loop: a plant, a controller with its prediction model, and the tracking performance of a flight."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax import checks
from hybrid_jax.control import observer
from hybrid_jax.control.attitude import heading
from hybrid_jax.control.controller import Controller, Plan, promote
from hybrid_jax.control.cost import Scalar
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import disturbed
from hybrid_jax.state import POSITION, QUATERNION, STATE_SIZE, Input, State

Plant = Callable[[State, Input, Scalar], State]  # the state one period after time t [s], u held

# Within this share of its range of a limit a rotor speed counts as saturated; tanh leaves 0.25 %.
SATURATION_MARGIN = 0.01


class Flight(eqx.Module):
    """A closed-loop flight of t periods."""

    x: Float[Array, "*n t+1 13"]  # states, the initial one first
    u: Float[Array, "*n t 4"]  # rotor speeds held over each period, rad/s
    plans: Plan  # of the controller at each call
    disturbance: Float[Array, "*n t 6"]  # of the observer at each call, see `observer.Estimate`


class Performance(eqx.Module):
    """Tracking performance of a flight."""

    position_rmse: Scalar  # m
    yaw_rmse: Scalar  # rad
    largest_error: Scalar  # of position, m
    crashed: Bool[Array, ""]  # below the ground, too far from the reference, or not finite
    saturation: Scalar  # share of the rotor speeds at a limit


def fly(
    plant: Plant,
    model: AbstractVectorField,
    reference: Float[Array, "n 13"],
    x0: State,
    controller: Controller,
    bandwidth: Scalar | float = 0.0,
) -> Flight:
    """Fly a plant along a reference for n − 1 − horizon periods.

    The function is pure: use it under `jit`, and under `vmap` over plants, models, references, initial states and
    bandwidths. A crash does not stop a flight; one that diverges continues as infinity or NaN. `plans` is by far the
    largest part of the result and costs nothing if a compiled function does not return it.

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
    x0, reference = checks.floating("x0", x0), checks.floating("reference", reference)
    if x0.shape != (STATE_SIZE,) or reference.ndim != 2 or reference.shape[1] != STATE_SIZE:
        raise ValueError(f"x0 (13,) and reference (n, 13) expected, got {x0.shape} and {reference.shape}")
    periods = len(reference) - 1 - controller.steps * controller.stride
    if periods < 1:
        raise ValueError(f"reference must be longer than the horizon, got {len(reference)} samples")
    checks.unit_quaternions("x0", x0)
    checks.unit_quaternions("reference", reference)
    x0, reference, plan = promote(x0, reference, controller.begin())

    def tick(carry, i):
        x, plan, estimate = carry
        estimate = observer.correct(estimate, x, bandwidth, controller.period)
        corrected = disturbed(model, estimate.disturbance)
        u, plan = controller(corrected, controller.horizon(reference, i), x, plan)
        estimate = observer.predict(estimate, model, x, u, controller.period)
        x = plant(x, u, i * controller.period).astype(x.dtype)
        return (x, plan, estimate), (x, u, plan, estimate.disturbance)

    start = (x0, plan, observer.begin(x0))
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
