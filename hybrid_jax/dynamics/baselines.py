"""The simplest predictions of a vehicle's motion, as vector fields: the reference that a model must beat.

A linear residual is another: see `hybrid_jax.adaptation.ridge`.
"""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, apply_residual, infer_batch, train_batch, update_running_stats
from hybrid_jax.state import BODY_RATES


class HoldState(AbstractVectorField):
    """ẋ = 0: the state does not change."""

    accepts_batch: ClassVar[bool] = True

    def __call__(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return jnp.zeros_like(x)


class FrozenRates(AbstractVectorField):
    """The field inside with ω̇ = 0: thrust accelerates the vehicle, which keeps its body rates."""

    accepts_batch: ClassVar[bool] = True

    field: AbstractVectorField

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " 4 *b"]) -> Float[Array, " 13 *b"]:
        return _frozen(self.field(x, u))

    def train_batch(self, x, u):
        return _frozen(train_batch(self.field, x, u))

    def infer_batch(self, x, u):
        return _frozen(infer_batch(self.field, x, u))

    def update_running_stats(self, x, u):
        return FrozenRates(update_running_stats(self.field, x, u))

    def apply_residual(self, x, residual):
        return apply_residual(self.field, x, residual)


def _frozen(derivative: Float[Array, " 13 *b"]) -> Float[Array, " 13 *b"]:
    return derivative.at[BODY_RATES].set(0.0)
