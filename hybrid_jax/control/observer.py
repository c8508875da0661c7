"""The disturbance observer: a constant acceleration beyond the model, between sensors and controller."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.control.cost import Scalar
from hybrid_jax.control.sensitivities import advance
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import disturbed
from hybrid_jax.dynamics.estimator import AbstractEstimator
from hybrid_jax.rotation import canonicalize_quaternion
from hybrid_jax.state import BODY_RATES, QUATERNION, VELOCITY, Input, State

MOTION = slice(VELOCITY.start, BODY_RATES.stop)


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


class Observer(AbstractEstimator):
    """The disturbance observer, see `Estimate`, around a prediction model.

    Attributes:
        field: the prediction model without a disturbance.
        bandwidth: of the observer [rad/s]; 0 leaves the disturbance at zero.
        period: time between two samples [s].
    """

    field: AbstractVectorField
    bandwidth: Scalar | float
    period: float = eqx.field(static=True)

    def begin(self, x):
        return Watched(Estimate.begin(x), x)

    def update(self, state, x, u):
        expected = state.estimate.predict(self.field, state.x, u, self.period)
        return Watched(expected.correct(x, self.bandwidth, self.period), x)

    def model(self, state):
        return disturbed(self.field, state.disturbance)


class Watched(eqx.Module):
    """State of an `Observer`."""

    estimate: Estimate
    x: State  # the last sample

    @property
    def disturbance(self) -> Float[Array, "*n 6"]:
        return self.estimate.disturbance
