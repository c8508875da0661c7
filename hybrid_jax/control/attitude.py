"""Attitude: errors that are equal for q and −q and do not vanish at half a turn, heading, and a recovery controller."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.rotation import Quaternion, Vector, conjugate, multiply
from hybrid_jax.state import BODY_RATES, QUATERNION, Input, State
from hybrid_jax.vehicle import Vehicle

# 1/s² and 1/s: the largest gains of the recovery that are stable with inputs held for 0.05 s.
ATTITUDE_GAIN, RATE_GAIN = 30.0, 10.0


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


def recovery_speeds(vehicle: Vehicle, reference: State, x: State) -> Input:
    """Rotor speeds [rad/s] that turn a multirotor to the reference attitude: a warm start for the controller.

    After a large initial rate the shifted plan may contain a full roll, at a hundred times the least cost, and every
    small change of it costs more. These speeds, without limits, give hover thrust and the angular acceleration
    −30 φ − 10 (ω − ω_ref) [rad/s²], φ the attitude error, by the vehicle's nominal constants.
    """
    angle = attitude_error(reference[QUATERNION], x[QUATERNION])
    acceleration = -ATTITUDE_GAIN * angle - RATE_GAIN * (x[BODY_RATES] - reference[BODY_RATES])
    weight = jnp.asarray([vehicle.mass * vehicle.gravity], x.dtype)
    wrench = jnp.concatenate([weight, jnp.asarray(vehicle.inertia, x.dtype) * acceleration])
    px, py = np.array(vehicle.rotor_positions).T
    k, c_m = vehicle.thrust_coefficient, vehicle.torque_coefficient
    mixer = np.stack([k * np.ones(4), k * py, -k * px, c_m * np.array(vehicle.spin)])
    return jnp.sqrt(jnp.maximum(jnp.asarray(np.linalg.pinv(mixer), x.dtype) @ wrench, 0.0))
