"""Quaternion algebra; q = (w, x, y, z) turns body vectors into world vectors.

Source: Solà, "Quaternion kinematics for the error-state Kalman filter", 2017 (Hamilton convention).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Quaternion = Float[Array, "4"]
Vector = Float[Array, "3"]
Rows = tuple[Float[Array, " *b"], ...]  # the entries of a vector, of one sample or of many


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def conjugate(q: Quaternion) -> Quaternion:
    w, x, y, z = q
    return jnp.stack([w, -x, -y, -z])


def rotate(q: Quaternion, v: Vector) -> Vector:
    """Rotate a body vector into the world frame: the vector part of q ⊗ [0, v] ⊗ q̄, scaled by |q|² if q is not unit."""
    return multiply(multiply(q, jnp.stack([jnp.zeros_like(v[0]), *v])), conjugate(q))[1:]


def matrix(q: Quaternion | Rows) -> tuple[Rows, Rows, Rows]:
    """Return the rows of R, with R v = rotate(q, v)."""
    w, x, y, z = q
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    wx, wy, wz, xy, xz, yz = w * x, w * y, w * z, x * y, x * z, y * z
    return (
        (ww + xx - yy - zz, 2 * (xy - wz), 2 * (xz + wy)),
        (2 * (xy + wz), ww - xx + yy - zz, 2 * (yz - wx)),
        (2 * (xz - wy), 2 * (yz + wx), ww - xx - yy + zz),
    )


def body_z(q: Quaternion | Rows) -> Vector:
    """Return rotate(q, [0, 0, 1]), the direction of thrust in the world frame."""
    return jnp.stack([row[2] for row in matrix(q)])


def derivative(q: Quaternion | Rows, body_rates: Vector | Rows) -> Quaternion:
    """Return q̇ = ½ q ⊗ [0, ω]  [1/s] for body rates ω [rad/s]."""
    (w, x, y, z), (a, b, c) = q, body_rates
    rows = -x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a
    return 0.5 * jnp.stack(rows)


def normalise(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    return q / jnp.linalg.norm(q, axis=-1, keepdims=True)


def from_axis_angle(axis: Vector, angle: Float[Array, ""]) -> Quaternion:
    """Return the rotation by an angle [rad] about a unit axis."""
    half = jnp.asarray(angle) / 2
    return jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * jnp.asarray(axis)])


def from_rotation_vector(v: Vector) -> Quaternion:
    """Return the rotation by |v| [rad] about v, the inverse of `rotation_vector`."""
    square = v @ v
    small = square < 1e-8  # there the next term of the series is below single precision
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    factor = jnp.where(small, 0.5 - square / 48, jnp.sin(angle / 2) / angle)
    return jnp.concatenate([jnp.where(small, 1 - square / 8, jnp.cos(angle / 2))[None], factor * v])


def rotation_vector(q: Quaternion) -> Vector:
    """Return the rotation vector [rad] of q or −q, of any norm. Unlike its sine, its length is not 0 but π at π."""
    w, v = jnp.where(q[0] < 0, -q[0], q[0]), jnp.where(q[0] < 0, -q[1:], q[1:])
    square = v @ v
    small = square < 1e-8 * w * w  # there the next term of the series is below single precision
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    factor = jnp.where(small, 2 / jnp.where(small, w, 1.0), 2 * jnp.arctan2(sine, w) / sine)
    return factor * v


def attitude_error(reference: Quaternion, q: Quaternion) -> Vector:
    """Return the rotation vector [rad, body frame] from the reference attitude to q."""
    return rotation_vector(multiply(conjugate(reference), q))


def tilt(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle [rad] between the body's z axis and the vertical, for unit quaternions."""
    of = jnp if isinstance(q, jax.Array) else np
    return of.arccos(of.clip(1 - 2 * (q[..., 1] ** 2 + q[..., 2] ** 2), -1, 1))  # pyright: ignore[reportReturnType]


def heading(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch"]:
    """Return the yaw [rad], the first of the Euler angles z, y, x."""
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    return jnp.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
