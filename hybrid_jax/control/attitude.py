"""Errors of attitude and heading that mean the same for q and −q and do not vanish at half a turn."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.rotation import Quaternion, Vector, conjugate, multiply


def rotation_vector(q: Quaternion) -> Vector:
    """The rotation vector [rad], at most π long, of the rotation q; that of −q is the same.

    q need not have length 1. The sine of the angle would be shorter to write, but it is 0 at half a turn, where a
    controller that minimises it stays for ever.
    """
    w, v = jnp.where(q[0] < 0, -q[0], q[0]), jnp.where(q[0] < 0, -q[1:], q[1:])
    square = v @ v
    small = square < 1e-8 * w * w  # there the next term of the series is below rounding in single precision
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    factor = jnp.where(small, 2 / jnp.where(small, w, 1.0), 2 * jnp.arctan2(sine, w) / sine)
    return factor * v


def attitude_error(reference: Quaternion, q: Quaternion) -> Vector:
    """The rotation vector [rad, body frame] that turns the reference attitude into q."""
    return rotation_vector(multiply(conjugate(reference), q))


def one_sheet(q: Quaternion) -> Quaternion:
    """Of q and −q the one whose first entry that is not 0 is positive.

    A rotation has two quaternions and a network, which takes them for different states, was trained near w > 0.
    """
    return q * jnp.sign(q[jnp.argmax(q != 0)])


def heading(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch"]:
    """Yaw [rad]: the direction of the body's x axis seen from above, the first of the Euler angles z, y, x."""
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    return jnp.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
