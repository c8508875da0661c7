"""Baseline predictions of a vehicle's motion as vector fields; for a linear one see `hybrid_jax.adaptation.ridge`."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import rotation
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.composition import AbstractWrapper
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.vehicle import BODY_RATES, QUATERNION, VELOCITY


class HoldState(AbstractVectorField):
    """A baseline with ẋ = 0: the state does not change."""

    accepts_batch: ClassVar[bool] = True

    def __call__(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return jnp.zeros_like(x)


class Kinematics(AbstractVectorField):
    """ṗ = v and q̇ = ½ q ⊗ [0, ω] with v̇ = ω̇ = 0: exact kinematics without knowledge of forces."""

    accepts_batch: ClassVar[bool] = True

    @property
    def state_space(self):
        return RIGID_BODY_SPACE

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " rotors *b"]) -> Float[Array, " 13 *b"]:
        accelerations = jnp.zeros((6, *x.shape[1:]), x.dtype)
        return jnp.concatenate([x[VELOCITY], rotation.derivative(x[QUATERNION], x[BODY_RATES]), accelerations])


class FrozenRates(AbstractWrapper):
    """A baseline with ω̇ = 0: thrust accelerates the vehicle, and its body rates stay constant."""

    def write(self, x, inside):
        return inside.at[BODY_RATES].set(0.0)
