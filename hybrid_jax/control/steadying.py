"""Rotor speeds that turn a multirotor to a wanted attitude: the plan to start from when there is no better one.

Without it the controller may keep to a plan of a full roll after an upset, at a hundred times the least cost: every
small change of such a plan makes it worse.
"""

import jax.numpy as jnp
import numpy as np

from hybrid_jax.control.attitude import attitude_error
from hybrid_jax.state import BODY_RATES, QUATERNION, Input, State
from hybrid_jax.vehicle import Vehicle

STIFFNESS, RATE_GAIN = 30.0, 10.0  # 1/s² and 1/s: as stiff as inputs that are held for 0.05 s bear


def steadying_speeds(vehicle: Vehicle, reference: State, x: State) -> Input:
    """Rotor speeds [rad/s], not yet limited, with the thrust of hover and α = −30 φ − 10 (ω − ω_ref) [rad/s²].

    φ is the attitude error; the vehicle's nominal constants say what speeds that takes.
    """
    turn = attitude_error(reference[QUATERNION], x[QUATERNION])
    spin_up = -STIFFNESS * turn - RATE_GAIN * (x[BODY_RATES] - reference[BODY_RATES])
    weight = jnp.asarray([vehicle.mass * vehicle.gravity], x.dtype)
    wrench = jnp.concatenate([weight, jnp.asarray(vehicle.inertia, x.dtype) * spin_up])
    return jnp.sqrt(jnp.maximum(jnp.asarray(_squared_speeds(vehicle), x.dtype) @ wrench, 0.0))


def _squared_speeds(vehicle: Vehicle) -> np.ndarray:
    """The matrix from thrust [N] and torques [N m] to squared rotor speeds; least squares if the arms are too few."""
    x, y = np.array(vehicle.rotor_positions).T
    k, c_m = vehicle.thrust_coefficient, vehicle.torque_coefficient
    return np.linalg.pinv(np.stack([k * np.ones(4), k * y, -k * x, c_m * np.array(vehicle.spin)]))
