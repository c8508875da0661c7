"""The true systems of the paper: the source and its two targets."""

from dataclasses import asdict, dataclass, replace
from typing import Any

from hybrid_jax import checks
from hybrid_jax.sim.forces import DRAG_COEFFICIENT, Force, Parameters, drag, ground_effect, parameters_of, wind
from hybrid_jax.sim.quadrotor import Quadrotor
from hybrid_jax.vehicle import IRIS, Vehicle


@dataclass(frozen=True)
class Domain:
    """A true system: the vehicle, its drag C_D [kg/s] and the forces on it beyond thrust and gravity.

    Raises:
        ValueError: no vehicle, a drag that is negative or not finite, or a force that is no function.
    """

    name: str
    vehicle: Vehicle = IRIS
    drag_coefficient: float = DRAG_COEFFICIENT
    forces: tuple[Force, ...] = (drag, ground_effect)

    def __post_init__(self):
        if not isinstance(self.vehicle, Vehicle):
            raise ValueError(f"vehicle must be a Vehicle, got {checks.short_repr(self.vehicle)}")
        checks.not_negative("drag_coefficient", self.drag_coefficient)
        if not isinstance(self.forces, tuple) or not all(callable(force) for force in self.forces):
            raise ValueError(f"forces must be a tuple of functions, got {checks.short_repr(self.forces)}")

    def parameters(self) -> Parameters:
        """Its numbers, in the precision that is on when this is called."""
        return parameters_of(self.vehicle, self.drag_coefficient)

    def quadrotor(self) -> Quadrotor:
        """Its dynamics, in the precision that is on when this is called."""
        return Quadrotor(self.parameters(), self.forces)

    def describe(self) -> dict[str, Any]:
        """Its fields as JSON would hold them."""
        return {
            "domain": self.name,
            "vehicle": asdict(self.vehicle),
            "drag_coefficient": self.drag_coefficient,
            "forces": [force.__name__ for force in self.forces],
        }


SOURCE = Domain("source")
# Table 1: Ix 0.02912 → 0.04000, Iy 0.02912 → 0.02000.
PARAMETER_SHIFT = Domain("parameter_shift", vehicle=replace(IRIS, inertia=(0.04, 0.02, IRIS.inertia[2])))
EXTERNAL_FORCE = Domain("external_force", forces=(drag, ground_effect, wind))
DOMAINS = {domain.name: domain for domain in (SOURCE, PARAMETER_SHIFT, EXTERNAL_FORCE)}
