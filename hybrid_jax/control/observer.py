"""A disturbance observer: what accelerates the vehicle beyond its model, taken as constant, from the prediction error.

The form is that of Chen, Yang, Guo and Li, "Disturbance-observer-based control and related methods", 2016, in discrete
time: the model with the disturbance d in it predicts v and ω one period ahead; what it misses, divided by the period,
is the error of d, and a first-order filter of bandwidth β takes a share 1 − exp(−β period) of it.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.control.attitude import one_sheet
from hybrid_jax.control.sensitivities import advance
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import disturbed
from hybrid_jax.state import BODY_RATES, QUATERNION, VELOCITY, Input, State

Disturbance = Float[Array, "6"]


class Estimate(eqx.Module):
    """What the observer carries from one period to the next.

    Attributes:
        disturbance: d, acceleration [m/s², world] and angular acceleration [rad/s², body].
        expected: v [m/s] and ω [rad/s] that are expected at the next sample.
    """

    disturbance: Disturbance
    expected: Float[Array, "6"]


def begin(x: State) -> Estimate:
    """No disturbance, and the state x as it is found."""
    return Estimate(jnp.zeros_like(x, shape=6), x[VELOCITY.start : BODY_RATES.stop])


def correct(estimate: Estimate, x: State, bandwidth: Float[Array, ""] | float, period: float) -> Estimate:
    """The estimate after a sample x; bandwidth [rad/s], where 0 leaves the disturbance at 0: no observer."""
    missed = (x[VELOCITY.start : BODY_RATES.stop] - estimate.expected) / period
    share = -jnp.expm1(-bandwidth * period)
    return Estimate(estimate.disturbance + share * missed, estimate.expected)


def predict(estimate: Estimate, field: AbstractVectorField, x: State, u: Input, period: float) -> Estimate:
    """The estimate that expects what the disturbed field does with u held from x for one period [s]."""
    x = x.at[QUATERNION].set(one_sheet(x[QUATERNION]))
    ahead = advance(disturbed(field, estimate.disturbance), x, u, period)
    return Estimate(estimate.disturbance, ahead[VELOCITY.start : BODY_RATES.stop])
