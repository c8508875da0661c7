"""Disturbance observer: estimates a constant acceleration beyond the model from one-step prediction errors.

The discrete-time form of Chen, Yang, Guo and Li, "Disturbance-observer-based control and related methods", 2016. The
model with the disturbance d predicts v and ω one period ahead. The prediction error divided by the period is the error
of d. A first-order filter of bandwidth β adds the share 1 − exp(−β period) of it to d.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.control.attitude import canonicalize_quaternion
from hybrid_jax.control.sensitivities import advance
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import disturbed
from hybrid_jax.state import BODY_RATES, QUATERNION, VELOCITY, Input, State


class Estimate(eqx.Module):
    """State of the observer."""

    disturbance: Float[Array, "6"]  # d: acceleration [m/s², world] and angular acceleration [rad/s², body]
    expected: Float[Array, "6"]  # v [m/s] and ω [rad/s] predicted for the next sample


def begin(x: State) -> Estimate:
    """Zero disturbance at state x."""
    return Estimate(jnp.zeros_like(x, shape=6), x[VELOCITY.start : BODY_RATES.stop])


def correct(estimate: Estimate, x: State, bandwidth: Float[Array, ""] | float, period: float) -> Estimate:
    """Update with the sample x; a bandwidth [rad/s] of 0 leaves the disturbance as it is."""
    error = (x[VELOCITY.start : BODY_RATES.stop] - estimate.expected) / period
    share = -jnp.expm1(-bandwidth * period)
    return Estimate(estimate.disturbance + share * error, estimate.expected)


def predict(estimate: Estimate, field: AbstractVectorField, x: State, u: Input, period: float) -> Estimate:
    """Predict the next sample with u held from x for one period [s]."""
    x = x.at[QUATERNION].set(canonicalize_quaternion(x[QUATERNION]))
    x_next = advance(disturbed(field, estimate.disturbance), x, u, period)
    return Estimate(estimate.disturbance, x_next[VELOCITY.start : BODY_RATES.stop])
