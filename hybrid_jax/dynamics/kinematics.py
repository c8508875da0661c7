"""Kinematics of a free body: the part of ẋ that holds without any knowledge of forces."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import rotation
from hybrid_jax.dynamics.base import AbstractVectorField, infer_batch, train_batch
from hybrid_jax.state import BODY_RATES, QUATERNION, VELOCITY


class Kinematics(AbstractVectorField):
    """ṗ = v and q̇ = ½ q ⊗ [0, ω], with v̇ = ω̇ = 0.

    x (13,) and u (4,) may have trailing batch axes.
    """

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " 4 *b"]) -> Float[Array, " 13 *b"]:
        accelerations = jnp.zeros((6, *x.shape[1:]), x.dtype)
        return jnp.concatenate([x[VELOCITY], rotation.derivative(x[QUATERNION], x[BODY_RATES]), accelerations])


@train_batch.register(Kinematics)
@infer_batch.register(Kinematics)
def kinematics_batch(field, x, u):
    return field(x, u)
