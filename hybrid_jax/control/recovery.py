"""Attitude-recovery warm start: rotor speeds of a PD controller that turn a multirotor to the reference attitude.

After a large initial rate the shifted plan may contain a full roll, at a hundred times the least cost, and every small
change of it costs more. The controller then starts from these speeds instead.
"""

import jax.numpy as jnp
import numpy as np

from hybrid_jax.control.attitude import attitude_error
from hybrid_jax.state import BODY_RATES, QUATERNION, Input, State
from hybrid_jax.vehicle import Vehicle

# 1/s² and 1/s: the largest gains that are stable with inputs held for 0.05 s.
ATTITUDE_GAIN, RATE_GAIN = 30.0, 10.0


def recovery_speeds(vehicle: Vehicle, reference: State, x: State) -> Input:
    """Rotor speeds [rad/s], without limits, for hover thrust and α = −30 φ − 10 (ω − ω_ref) [rad/s²].

    φ is the attitude error. The allocation uses the vehicle's nominal constants.
    """
    angle = attitude_error(reference[QUATERNION], x[QUATERNION])
    acceleration = -ATTITUDE_GAIN * angle - RATE_GAIN * (x[BODY_RATES] - reference[BODY_RATES])
    weight = jnp.asarray([vehicle.mass * vehicle.gravity], x.dtype)
    wrench = jnp.concatenate([weight, jnp.asarray(vehicle.inertia, x.dtype) * acceleration])
    return jnp.sqrt(jnp.maximum(jnp.asarray(_allocation(vehicle), x.dtype) @ wrench, 0.0))


def _allocation(vehicle: Vehicle) -> np.ndarray:
    """Matrix (4, 4) from thrust [N] and torques [N m] to squared rotor speeds: the pseudo-inverse of the mixer."""
    x, y = np.array(vehicle.rotor_positions).T
    k, c_m = vehicle.thrust_coefficient, vehicle.torque_coefficient
    return np.linalg.pinv(np.stack([k * np.ones(4), k * y, -k * x, c_m * np.array(vehicle.spin)]))
