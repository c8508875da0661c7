"""Changes of the Iris for comparisons of adaptation methods: the paper's two, and five more."""

from dataclasses import replace

import numpy as np

from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE, Domain
from hybrid_jax.sim.forces import drag, ground_effect, gusty_wind, weak_rotor, wind
from hybrid_jax.vehicle import IRIS, Vehicle


def loaded(vehicle: Vehicle, mass: float, place: tuple[float, float, float]) -> Vehicle:
    """The vehicle with a point mass [kg] at a place [m, body frame]; products of inertia are neglected."""
    total, at = vehicle.mass + mass, np.asarray(place)
    centre = mass / total * at

    def about(offset: np.ndarray) -> np.ndarray:
        return np.sum(offset**2) - offset**2

    inertia = vehicle.inertia + vehicle.mass * about(centre) + mass * about(at - centre)
    rotors = np.asarray(vehicle.rotor_positions) - centre[:2]
    positions = tuple(map(tuple, rotors.tolist()))
    return replace(vehicle, mass=total, inertia=tuple(inertia.tolist()), rotor_positions=positions)


LOADED = loaded(IRIS, 0.3, (0.04, 0.03, -0.05))
DOUBLED_DRAG = Domain("doubled_drag", drag_coefficient=2 * SOURCE.drag_coefficient)
WEAK_ROTOR = Domain("weak_rotor", forces=(drag, ground_effect, weak_rotor))
OFF_CENTRE_LOAD = Domain("off_centre_load", LOADED, SOURCE.drag_coefficient, nominal=IRIS)
GUSTY_WIND = Domain("gusty_wind", forces=(drag, ground_effect, gusty_wind))
LOAD_AND_WIND = replace(OFF_CENTRE_LOAD, name="load_and_wind", forces=(drag, ground_effect, wind))
CHANGES = (PARAMETER_SHIFT, EXTERNAL_FORCE, DOUBLED_DRAG, WEAK_ROTOR, OFF_CENTRE_LOAD, GUSTY_WIND, LOAD_AND_WIND)
