"""The simulated vehicle as arrays, so that flights of different vehicles are lanes of one program."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.flying.changes import weak_rotor
from hybrid_jax.control.loop import Plant
from hybrid_jax.sim.domain import Domain, Quadrotor
from hybrid_jax.sim.forces import Parameters, Wrench, drag, ground_effect, parameters_of, wind
from hybrid_jax.vehicle import IRIS

FORCES = (drag, ground_effect, wind, weak_rotor)


class World(NamedTuple):
    """The true system of a flight: FORCES with share 1 act, and `clock` is the wind's time at the start [s]."""

    vehicle: Parameters
    shares: Float[Any, " f"]
    clock: Float[Any, ""]


def world_of(domain: Domain, clock: float = 0.0) -> World:
    vehicle = jax.tree.map(np.asarray, domain.quadrotor().parameters)
    shares = np.array([force in domain.forces for force in FORCES], np.float32)
    return World(vehicle, shares, np.asarray(clock, np.float32))


def plant_of(world: World, period: float) -> Plant:
    """Return the function to the state one period later, for `control.fly` and `Loop.tick`."""

    def force(x, u, t, parameters) -> Wrench:
        wrenches = [each(x, u, t, parameters) for each in FORCES]
        return Wrench(*(jnp.tensordot(world.shares, jnp.stack(parts), 1) for parts in zip(*wrenches, strict=True)))

    truth = Quadrotor(world.vehicle, (force,))
    return lambda x, u, t: truth.step(x, u, t + world.clock, period)


def wind_force(clock: Float[Any, ""]) -> Float[Any, "3"]:
    return wind(jnp.zeros(13), jnp.zeros(4), clock, parameters_of(IRIS)).force
