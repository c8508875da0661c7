"""Forces on the simulated vehicle: functions (x, u, t, parameters) → Wrench, to which you can add your own."""

import math
from collections.abc import Callable
from dataclasses import asdict, fields
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.rotation import body_z, normalise, rotate
from hybrid_jax.vehicle import POSITION, QUATERNION, VELOCITY, Input, State, Vehicle

Scalar = Float[Array, ""]

DRAG_COEFFICIENT = 0.4  # kg/s; the paper gives no value
WIND_MEAN = -4.0  # N
WIND_AMPLITUDE = 1.0  # N
WIND_ANGULAR_FREQUENCY = 2 / 3 * math.pi  # rad/s


class Wrench(NamedTuple):
    """A force and a torque on the body at its centre of mass, in the world frame (MuJoCo's xfrc_applied)."""

    force: Float[Array, "3"]  # N
    torque: Float[Array, "3"]  # N m


class Parameters(eqx.Module):
    """The parameters of a simulated vehicle (see `Vehicle`) as array leaves, so that they can be traced and vmapped."""

    mass: Scalar
    inertia: Float[Array, "3"]
    thrust_coefficient: Scalar
    torque_coefficient: Scalar
    rotor_positions: Float[Array, "rotors 3"]  # m, body frame, z = 0
    spin: Float[Array, " rotors"]
    rotor_radius: Scalar
    gravity: Scalar
    drag_coefficient: Scalar  # C_D, kg/s


def parameters_of(vehicle: Vehicle, drag_coefficient: float = DRAG_COEFFICIENT) -> Parameters:
    numbers = asdict(vehicle) | {
        "rotor_positions": [(x, y, 0.0) for x, y in vehicle.rotor_positions],
        "drag_coefficient": drag_coefficient,
    }
    # NumPy converts first, because JAX would compile a program for each shape.
    precision = jnp.result_type(float)
    return Parameters(*(jnp.asarray(np.asarray(numbers[field.name], precision)) for field in fields(Parameters)))


Force = Callable[[State, Input, Scalar, Parameters], Wrench]


def drag(x: State, u: Input, t: Scalar, parameters: Parameters) -> Wrench:
    """Return the drag D = −C_D v, linear in the velocity [m/s, world]."""
    velocity = x[VELOCITY]
    return Wrench(-parameters.drag_coefficient * velocity, jnp.zeros_like(velocity))


def wind(x: State, u: Input, t: Scalar, parameters: Parameters) -> Wrench:
    """Return the wind of experiment 2, [0, −4 + sin(⅔ π t), 0] N at time t [s]."""
    sideways = WIND_MEAN + WIND_AMPLITUDE * jnp.sin(WIND_ANGULAR_FREQUENCY * t)
    zeros = jnp.zeros_like(x[VELOCITY])
    return Wrench(zeros.at[1].set(sideways), zeros)


def ground_effect(x: State, u: Input, t: Scalar, parameters: Parameters) -> Wrench:
    """Return the thrust that ground effect adds to k u² of each rotor, and its torque (Eq. 11)."""
    gain = thrust_gain(rotor_altitudes(x, parameters.rotor_positions), parameters.rotor_radius)
    excess = (gain - 1) * parameters.thrust_coefficient * u**2
    q = normalise(x[QUATERNION])
    arm_torque = jnp.cross(parameters.rotor_positions, excess[:, None] * jnp.array([0.0, 0.0, 1.0])).sum(axis=0)
    return Wrench(excess.sum() * body_z(q), rotate(q, arm_torque))


def thrust_gain(altitude: Float[Array, "*rotors"], rotor_radius: Scalar) -> Float[Array, "*rotors"]:
    """Return T/T∞ = 1 / (1 − (R / 4h)²) of rotors at altitude h ≥ R/2 [m] (Cheeseman and Bennett 1955)."""
    height = jnp.maximum(altitude, rotor_radius / 2)
    return 1 / (1 - (rotor_radius / (4 * height)) ** 2)


def rotor_altitudes(x: State, rotor_positions: Float[Array, "rotors 3"]) -> Float[Array, " rotors"]:
    q = normalise(x[QUATERNION])
    return x[POSITION][2] + jax.vmap(rotate, in_axes=(None, 0))(q, rotor_positions)[:, 2]
