"""Vehicles that change in the air, of our simulator and of RotorPy: what agents know of them, and how they fly."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from experiments.flying import plant
from experiments.flying.changes import LOST_THRUST, weak_rotor
from experiments.worlds.flights import WORLDS, usual_flights
from experiments.worlds.iris import domain_of
from experiments.worlds.rotorpy import Constants, RotorPy, advance, derivative
from experiments.worlds.world import DT, NOTHING
from hybrid_jax.control.loop import Plant
from hybrid_jax.control.sensitivities import lagged_speeds
from hybrid_jax.dynamics import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.sim.flight import random_flights
from hybrid_jax.vehicle import Input, Vehicle

LEARNING = 10.0  # s of flight on which least squares is fitted
STILL = 1e-9  # m/s of air, since the norm of zero has no derivative


class Body(NamedTuple):
    """A vehicle as the agents model it, and the share of its thrust that rotor 0 has `lost`."""

    vehicle: Vehicle
    terms: Terms
    lost: float

    def drag(self, vehicle: Vehicle) -> Float[np.ndarray, "3"]:
        """Return the drag by these terms at another vehicle's hover speed, over this mass [1/s]."""
        of_rotors = vehicle.rotors * vehicle.hover_speed * np.array(self.terms.rotor_drag)
        return (np.array(self.terms.drag) + of_rotors) / self.vehicle.mass


class Equations(AbstractVectorField):
    """The equations of RotorPy in a steady wind, with rotors that follow at once."""

    constants: Constants

    @property
    def state_space(self):
        return RIGID_BODY_SPACE

    def __call__(self, x, u):
        return derivative(self.constants, x, u, u, jnp.asarray(self.constants.wind) + STILL)[0]


def is_rotorpy(world: str) -> bool:
    return isinstance(WORLDS[world], RotorPy)


def body_of(world: str, change: str = NOTHING) -> Body:
    """Return a vehicle after a change; of RotorPy without the drag of the frame."""
    own, vehicle = WORLDS[world], WORLDS[world].changed(change)
    if not isinstance(own, RotorPy):
        domain = domain_of(change)
        drag = domain.drag_coefficient
        return Body(vehicle, Terms(drag=(drag, drag, drag)), LOST_THRUST * (weak_rotor in domain.forces))
    c = own.truth(change)
    terms = Terms(rotor_drag=c.rotor_drag, translational_lift=len(c.rotors) * c.lift)
    return Body(vehicle, terms, 1 - c.efficiency[0])


def truth_of(world: str, change: str, clock: float) -> Any:
    """Return the true vehicle as arrays; `clock` is the time of our simulator's wind at the start [s]."""
    own = WORLDS[world]
    if isinstance(own, RotorPy):
        return Constants(*(np.asarray(each, np.float32) for each in own.truth(change)))  # type: ignore
    return plant.world_of(domain_of(change), clock)


def plant_of(truth: Any, speeds: Input, lag: float) -> Plant:
    """Return the function to the state a period later, from these rotor speeds [rad/s] and their mean."""
    if not isinstance(truth, Constants):
        return plant.plant_of(truth, DT)
    share: Any = lagged_speeds(1.0, 0.0, lag, DT)[0]  # type: ignore  # of the speeds in their mean
    return lambda x, mean, t: advance(truth, x, speeds, (mean - share * speeds) / (1 - share), t)[0][0]


def ground_flights(world: str, change: str, flights: int, key: PRNGKeyArray) -> tuple[Any, Any]:
    """Return states, and rotor speeds in each interval, of random flights after a change."""
    if is_rotorpy(world):
        flown = usual_flights(WORLDS[world], change, flights, LEARNING, key)
        return flown.states, flown.averaged
    flown = random_flights(domain_of(change), flights, LEARNING, key)
    return flown.states, flown.inputs
