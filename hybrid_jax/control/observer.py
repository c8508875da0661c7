"""Observers of what a model does not include: a constant acceleration, or one predicted from past errors."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.control.cost import Scalar
from hybrid_jax.control.sensitivities import advance
from hybrid_jax.dynamics import ConstantDisturbance, DisturbanceModel, Hybrid
from hybrid_jax.dynamics.base import AbstractEstimator, AbstractVectorField, as_field
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.vehicle import BODY_RATES, VELOCITY, State

MOTION = slice(VELOCITY.start, BODY_RATES.stop)


class ObserverState(eqx.Module):
    """State of an `Observer`."""

    disturbance: Float[Array, "*n 6"]  # acceleration [m/s², world] and angular acceleration [rad/s², body]
    x: State  # the last sample


class Observer(AbstractEstimator):
    """Estimate a constant acceleration beyond a prediction model from one-step prediction errors.

    This is the discrete-time form of Chen, Yang, Guo and Li, "Disturbance-observer-based control and related methods",
    2016: the prediction error divided by the period is the error of d, and a first-order filter of bandwidth β adds the
    share 1 − exp(−β period) of it to d.

    Attributes:
        field: the prediction model without a disturbance.
        bandwidth: bandwidth of the observer [rad/s]; 0 keeps the disturbance at zero.
        period: time between two samples [s].
    """

    field: AbstractVectorField
    bandwidth: Scalar | float
    period: float = eqx.field(static=True)

    def begin(self, x):
        return ObserverState(jnp.zeros_like(x, shape=6), x)

    def update(self, state, x, u):
        before = RIGID_BODY_SPACE.canonical(state.x, state.x)
        error = (x - advance(self.model(state), before, u, self.period))[MOTION] / self.period
        return ObserverState(state.disturbance - jnp.expm1(-self.bandwidth * self.period) * error, x)

    def model(self, state):
        return Hybrid(self.field, ConstantDisturbance(state.disturbance))


def observer_of(model: AbstractVectorField, bandwidth: Scalar | float, period: float) -> AbstractEstimator:
    """Return the observer of a model; ValueError if it cannot estimate hidden states, or would be a second observer."""
    if not as_field(model).hidden:
        return Observer(model, bandwidth, period)
    if not isinstance(model, DisturbanceModel):
        raise ValueError("model: nothing estimates its hidden states here; pass estimator=, or use fit_disturbance")
    if checks.is_traced(bandwidth) or bandwidth:
        raise ValueError("bandwidth must be 0, as the model itself observes its errors")
    return PastObserver(model, period)


class PastObserver(AbstractEstimator):
    """Estimate the state (x, z) of a model from `fit_disturbance`, whose filters z average the errors of its field.

    Attributes:
        field: the prediction model.
        period: time between two samples [s].
    """

    field: DisturbanceModel
    period: float = eqx.field(static=True)

    def begin(self, x):
        return jnp.concatenate([x, jnp.zeros(self.field.hidden, x.dtype)])

    def update(self, state, x, u):
        return self.field.after(state, advance(self.field.field, state[: len(x)], u, self.period), x, self.period)

    def model(self, state):
        return self.field

    def start(self, state, x):
        return state
