"""The simplest predictions of a vehicle's motion, as vector fields: what a model must beat, and what errors scale with.

A linear residual is another: see `linear_adaptation.linear_residual`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, apply_residual, infer_batch, train_batch, update_running_stats
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


@train_batch.register(HoldState)
@infer_batch.register(HoldState)
def _(field, x, u):
    return field(x, u)


@train_batch.register
def _(field: FrozenRates, x, u):
    return _frozen(train_batch(field.field, x, u))


@infer_batch.register
def _(field: FrozenRates, x, u):
    return _frozen(infer_batch(field.field, x, u))


@update_running_stats.register
def _(field: FrozenRates, x, u):
    return FrozenRates(update_running_stats(field.field, x, u))


@apply_residual.register
def _(field: FrozenRates, x, more):
    return apply_residual(field.field, x, more)
