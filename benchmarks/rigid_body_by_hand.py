"""A quadrotor as one writes it in JAX when it is the only one: no simulator, no other body, no other force."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.vehicle import Vehicle


def derivative(vehicle: Vehicle, x: Float[Array, "13"], u: Float[Array, "4"]) -> Float[Array, "13"]:
    """ẋ of a rigid body under the thrust k u² and the reaction torque c_m u² of each rotor; u [rad/s]."""
    q, v, omega = x[3:7], x[7:10], x[10:13]
    w, i, j, k = q / jnp.linalg.norm(q)
    up = jnp.stack([2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j)])
    arms, spin, inertia = (np.array(part) for part in (vehicle.rotor_positions, vehicle.spin, vehicle.inertia))
    lift = vehicle.thrust_coefficient * u**2
    torque = jnp.stack([arms[:, 1] @ lift, -arms[:, 0] @ lift, vehicle.torque_coefficient * spin @ u**2])
    real, axis = q[0], q[1:]
    turning = 0.5 * jnp.concatenate([-(axis @ omega)[None], real * omega + jnp.cross(axis, omega)])
    acceleration = lift.sum() / vehicle.mass * up - jnp.array([0.0, 0.0, vehicle.gravity])
    return jnp.concatenate([v, turning, acceleration, (torque - jnp.cross(omega, inertia * omega)) / inertia])
