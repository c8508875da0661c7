"""Measurement models of a multirotor's sensors, y = h(x, u)."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import rotation
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, VELOCITY

STATES = {"position": POSITION, "attitude": QUATERNION, "velocity": VELOCITY, "rates": BODY_RATES}
MEASURED = (*STATES, "body_velocity", "specific_force", "rotor_speed")


def measure(
    quantity: str, field: AbstractVectorField, x: Float[Array, " d"], u: Float[Array, " m"], gravity: float = 9.81
) -> Float[Array, " k"]:
    """h(x, u) of one of `MEASURED`, with `flights.recording.AXES`; the specific force is Rᵀ (v̇ + g e_z) [m/s²]."""
    if quantity in STATES:
        return x[STATES[quantity]]
    if quantity == "rotor_speed":
        return field.speeds(x, u)  # pyright: ignore[reportAttributeAccessIssue]
    vector = x[VELOCITY] if quantity == "body_velocity" else field(x, u)[VELOCITY].at[2].add(gravity)
    return rotation.rotate(rotation.conjugate(rotation.normalise(x[QUATERNION])), vector)


def difference(quantity: str, y: Float[Array | np.ndarray, " k"], predicted: Float[Array, " k"]) -> Float[Array, " e"]:
    """y minus its prediction; for attitudes, the rotation vector between them [rad, body frame] (3)."""
    y = jnp.asarray(y)
    return rotation.attitude_error(predicted, y) if quantity == "attitude" else y - predicted
