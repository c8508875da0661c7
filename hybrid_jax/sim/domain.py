"""True systems: the source domain of the paper and its two targets."""

from dataclasses import asdict, dataclass, replace
from typing import Any

from hybrid_jax import checks
from hybrid_jax.sim.forces import DRAG_COEFFICIENT, Force, drag, ground_effect, parameters_of, wind
from hybrid_jax.sim.pilot import scale_of
from hybrid_jax.sim.quadrotor import Quadrotor
from hybrid_jax.vehicle import IRIS, Vehicle

_DERIVED: Any = None  # a default that depends on the vehicle


@dataclass(frozen=True)
class Domain:
    """A true system: a vehicle and the forces on it beyond thrust and gravity.

    Raises:
        ValueError: not a vehicle, a drag coefficient that is negative or not finite, or a force that is not a function.
    """

    name: str
    vehicle: Vehicle = IRIS
    drag_coefficient: float = _DERIVED  # C_D [kg/s]; by default that of the Iris times the square of the size
    forces: tuple[Force, ...] = (drag, ground_effect)
    nominal: Vehicle = _DERIVED  # that the pilot of random flights is tuned for; by default the true one

    def __post_init__(self):
        object.__setattr__(self, "nominal", self.vehicle if self.nominal is None else self.nominal)
        for name in ("vehicle", "nominal"):
            if not isinstance(getattr(self, name), Vehicle):
                raise ValueError(f"{name} must be a Vehicle, got {checks.short_repr(getattr(self, name))}")
        if self.drag_coefficient is None:
            object.__setattr__(self, "drag_coefficient", DRAG_COEFFICIENT * scale_of(self.vehicle).length ** 2)
        checks.not_negative("drag_coefficient", self.drag_coefficient)
        if not isinstance(self.forces, tuple) or not all(callable(force) for force in self.forces):
            raise ValueError(f"forces must be a tuple of functions, got {checks.short_repr(self.forces)}")

    def quadrotor(self) -> Quadrotor:
        """The dynamics of the true system, in the current precision."""
        return Quadrotor(parameters_of(self.vehicle, self.drag_coefficient), self.forces)

    def describe(self) -> dict[str, Any]:
        """Its fields as JSON values. The Iris is not listed as the nominal vehicle: earlier datasets knew no other."""
        nominal = {} if self.nominal == IRIS else {"nominal": asdict(self.nominal)}
        return nominal | {
            "domain": self.name,
            "vehicle": asdict(self.vehicle),
            "drag_coefficient": self.drag_coefficient,
            "forces": [force.__name__ for force in self.forces],
        }


SOURCE = Domain("source")
# Table 1: Ix 0.02912 → 0.04000, Iy 0.02912 → 0.02000.
PARAMETER_SHIFT = Domain("parameter_shift", vehicle=replace(IRIS, inertia=(0.04, 0.02, IRIS.inertia[2])), nominal=IRIS)
EXTERNAL_FORCE = Domain("external_force", forces=(drag, ground_effect, wind))
DOMAINS = {domain.name: domain for domain in (SOURCE, PARAMETER_SHIFT, EXTERNAL_FORCE)}
