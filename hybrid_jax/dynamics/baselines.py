"""The simplest predictions of a vehicle's motion, as vector fields: what a model must beat, and what errors scale with.

A linear residual is another: see `linear_adaptation.linear_residual`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, deploy_batch, evaluate_batch, observe, taken_up
from hybrid_jax.state import BODY_RATES


class HoldState(AbstractVectorField):
    """ẋ = 0: the state stays what it is."""

    def __call__(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return jnp.zeros_like(x)


class FrozenRates(AbstractVectorField):
    """The field inside with ω̇ = 0: thrust moves the vehicle, and it goes on turning as it does."""

    field: AbstractVectorField

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " 4 *b"]) -> Float[Array, " 13 *b"]:
        return _frozen(self.field(x, u))


def _frozen(derivative: Float[Array, " 13 *b"]) -> Float[Array, " 13 *b"]:
    return derivative.at[BODY_RATES].set(0.0)


@evaluate_batch.register(HoldState)
@deploy_batch.register(HoldState)
def _(field, x, u):
    return field(x, u)


@evaluate_batch.register
def _(field: FrozenRates, x, u):
    return _frozen(evaluate_batch(field.field, x, u))


@deploy_batch.register
def _(field: FrozenRates, x, u):
    return _frozen(deploy_batch(field.field, x, u))


@observe.register
def _(field: FrozenRates, x, u):
    return FrozenRates(observe(field.field, x, u))


@taken_up.register
def _(field: FrozenRates, x, more):
    return taken_up(field.field, x, more)
