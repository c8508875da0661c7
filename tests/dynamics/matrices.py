"""The equations of motion of a multirotor a second time, with matrices."""

import numpy as np

from hybrid_jax.state import BODY_RATES, QUATERNION, VELOCITY


def newton_euler(x, u, vehicle, terms, k):
    """ẋ with matrices, a full inertia tensor and each rotor's force at its place."""
    w, *vector = x[QUATERNION]
    a, b, c = vector
    skew = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    attitude = np.eye(3) + 2 * w * skew + 2 * skew @ skew
    velocity, rates = attitude.T @ x[VELOCITY], x[BODY_RATES]
    force, torque = -np.diag(terms.drag) @ velocity, np.zeros(3)
    for place, sign, speed, one in zip(vehicle.rotor_positions, vehicle.spin, u, k, strict=True):
        lift = np.array([0, 0, one * speed**2])
        force = force + lift
        torque += np.cross([*(np.array(place) - terms.centre_of_mass), 0.0], lift)
        torque[2] += sign * vehicle.torque_coefficient * speed**2
    inertia = np.diag(vehicle.inertia)
    torque = np.array(terms.torque_gain) * torque
    force += np.array((*terms.cable_pull, 0.0)) * [torque[1], -torque[0], 0.0]
    torque += np.array(terms.aerodynamic_moment) @ velocity - np.array(terms.rate_damping) * rates
    acceleration = attitude @ force / vehicle.mass - [0, 0, vehicle.gravity]
    unseen = terms.velocity_lag * np.array([1, 1, 0]) * force / vehicle.mass
    moved = attitude @ (terms.velocity_gain * velocity + unseen)
    p, q, r = rates
    turning = 0.5 * np.array([[0, -p, -q, -r], [p, 0, r, -q], [q, -r, 0, p], [r, q, -p, 0]]) @ x[QUATERNION]
    spin_up = np.linalg.solve(inertia, torque - np.cross(rates, inertia @ rates))
    return np.concatenate([moved, turning, acceleration, spin_up])
