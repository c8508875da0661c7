"""Changes of the Iris for comparisons of adaptation methods: the paper's two, and five more."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from hybrid_jax.rotation import normalise, rotate
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE, Domain
from hybrid_jax.sim.forces import Parameters, Scalar, Wrench, drag, ground_effect, wind
from hybrid_jax.vehicle import IRIS, QUATERNION, Input, State, Vehicle

LOST_THRUST = 0.15  # of the weak rotor


def loaded(vehicle: Vehicle, mass: float, place: tuple[float, float, float]) -> Vehicle:
    """Return the vehicle with a point mass [kg] at a place [m, body frame]; products of inertia are neglected."""
    total, at = vehicle.mass + mass, np.asarray(place)
    centre = mass / total * at

    def about(offset: np.ndarray) -> np.ndarray:
        return np.sum(offset**2) - offset**2

    inertia = vehicle.inertia + vehicle.mass * about(centre) + mass * about(at - centre)
    rotors = np.asarray(vehicle.rotor_positions) - centre[:2]
    positions = tuple(map(tuple, rotors.tolist()))
    return replace(vehicle, mass=total, inertia=tuple(inertia.tolist()), rotor_positions=positions)


def gusty_wind(x: State, u: Input, t: Scalar, parameters: Parameters) -> Wrench:
    """Blow with a mean force and two sines in each direction [N], t [s]."""
    mean = jnp.array([2.0, -2.5, 0.6], x.dtype)
    amplitude = jnp.array([[0.8, 0.5], [0.8, 0.5], [0.3, 0.2]], x.dtype)
    frequency = jnp.array([[1.3, 3.1], [0.9, 4.3], [2.2, 3.7]], x.dtype)  # rad/s, no two alike
    force = mean + jnp.sum(amplitude * jnp.sin(frequency * t), axis=1)
    return Wrench(force, jnp.zeros_like(force))


def weak_rotor(x: State, u: Input, t: Scalar, parameters: Parameters) -> Wrench:
    """Take a share of thrust and reaction torque from the first rotor."""
    lost, up, q = LOST_THRUST * u[0] ** 2, jnp.array([0.0, 0.0, 1.0], x.dtype), normalise(x[QUATERNION])
    thrust, reaction = lost * parameters.thrust_coefficient * up, lost * parameters.torque_coefficient * up
    torque = jnp.cross(parameters.rotor_positions[0], thrust) + parameters.spin[0] * reaction
    return Wrench(-rotate(q, thrust), -rotate(q, torque))


LOADED = loaded(IRIS, 0.3, (0.04, 0.03, -0.05))
DOUBLED_DRAG = Domain("doubled_drag", drag_coefficient=2 * SOURCE.drag_coefficient)
WEAK_ROTOR = Domain("weak_rotor", forces=(drag, ground_effect, weak_rotor))
OFF_CENTRE_LOAD = Domain("off_centre_load", LOADED, SOURCE.drag_coefficient, nominal=IRIS)
GUSTY_WIND = Domain("gusty_wind", forces=(drag, ground_effect, gusty_wind))
LOAD_AND_WIND = replace(OFF_CENTRE_LOAD, name="load_and_wind", forces=(drag, ground_effect, wind))
CHANGES = (PARAMETER_SHIFT, EXTERNAL_FORCE, DOUBLED_DRAG, WEAK_ROTOR, OFF_CENTRE_LOAD, GUSTY_WIND, LOAD_AND_WIND)
