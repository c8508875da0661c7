"""Attitude and heading errors that are equal for q and −q and do not vanish at half a turn."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.rotation import Quaternion, Vector, conjugate, multiply


def rotation_vector(q: Quaternion) -> Vector:
    """Rotation vector [rad] of q, at most π long and equal for q and −q; q need not have length 1.

    The sine of the angle would be simpler, but it is 0 at half a turn, where a controller that minimises it stays.
    """
    w, v = jnp.where(q[0] < 0, -q[0], q[0]), jnp.where(q[0] < 0, -q[1:], q[1:])
    square = v @ v
    small = square < 1e-8 * w * w  # there the next term of the series is below single precision
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    factor = jnp.where(small, 2 / jnp.where(small, w, 1.0), 2 * jnp.arctan2(sine, w) / sine)
    return factor * v


def attitude_error(reference: Quaternion, q: Quaternion) -> Vector:
    """Rotation vector [rad, body frame] from the reference attitude to q."""
    return rotation_vector(multiply(conjugate(reference), q))


def canonicalize_quaternion(q: Quaternion) -> Quaternion:
    """Whichever of q and −q has a positive first nonzero entry.

    Both are the same rotation, but different inputs to a network, which was trained near w > 0.
    """
    return q * jnp.sign(q[jnp.argmax(q != 0)])


def heading(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch"]:
    """Yaw [rad], the first of the Euler angles z, y, x."""
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    return jnp.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
