"""The flights of the closed-loop experiment: which models fly which reference in which domain, and from where."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.closed_loop.rows import Agent, away
from hybrid_jax.control import figure_eight, hover, low_pass, step
from hybrid_jax.control.cost import Scalar
from hybrid_jax.control.references import Path
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, Domain
from hybrid_jax.sim.forces import Parameters
from hybrid_jax.sweep.lanes import count, lane

ALTITUDE = 1.5  # m
DOMAINS = (PARAMETER_SHIFT, EXTERNAL_FORCE)  # the two changes
FORCES = EXTERNAL_FORCE.forces  # all that act in any domain
ModelSet = Mapping[Agent, AbstractVectorField]  # stacked over seeds


def _crossing(t: Scalar) -> tuple[Float[Array, "3"], Scalar]:
    """A low pass that crosses home after 5 s."""
    position, yaw = low_pass(speed=2.0)(t)
    return position - jnp.array([10.0, 0.0, 0.0]), yaw


PATHS: Mapping[str, Path] = {
    "hover": hover((0.0, 0.0, ALTITUDE)),
    "figure_eight": figure_eight(3.5, altitude=ALTITUDE),
    "fast_figure_eight": figure_eight(6.0, altitude=ALTITUDE),
    "step": step((1.0, 1.0, 0.5), yaw=np.pi / 2, altitude=ALTITUDE),
    "low_pass": _crossing,
    "upset": hover((0.0, 0.0, ALTITUDE)),  # the initial state has a body rate
}


class Flight(NamedTuple):
    """The arrays that define one flight."""

    model: AbstractVectorField  # of the controller
    vehicle: Parameters  # the true one
    shares: Float[Any, " f"]  # of each of FORCES, 1 where it acts
    path: Int[Any, ""]  # index into PATHS
    home: Float[Any, "3"]  # offset of the reference [m, world]
    bandwidth: Float[Any, ""]  # of the disturbance observer [rad/s]; 0 for none


@dataclass(frozen=True)
class Scenario:
    """Flights of a set of models in one domain along one of PATHS."""

    domain: Domain
    reference: str
    distance: float  # from home [m], equally far in x and y
    models: ModelSet
    bandwidth: float  # of the disturbance observers [rad/s]

    @property
    def name(self) -> str:
        """In messages and file names."""
        return f"{self.domain.name} {self.reference}{away(self.distance).replace(',', '')}"

    def keys(self) -> list[tuple[Agent, int]]:
        """The agent and the seed of each flight."""
        return [(agent, seed) for agent, models in self.models.items() for seed in range(count(models))]

    def flights(self) -> Iterator[Flight]:
        """In the order of `keys`."""
        home = np.array([self.distance, self.distance, 0.0], np.float32) / np.float32(np.sqrt(2))
        vehicle = self.domain.quadrotor().parameters
        shares = np.array([force in self.domain.forces for force in FORCES], np.float32)
        path = np.asarray(list(PATHS).index(self.reference), np.int32)
        for agent, seed in self.keys():
            bandwidth = np.asarray(self.bandwidth * agent.observer, np.float32)
            yield Flight(lane(self.models[agent], seed), vehicle, shares, path, home, bandwidth)
