"""Simulated systems, the paper's source domain and its two targets, with accelerations of MuJoCo MJX and RK4.

Every stage recomputes the forces. MJX's own steps freeze xfrc_applied, which makes them first order in drag.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from hybrid_jax import checks
from hybrid_jax.rotation import derivative as quaternion_derivative
from hybrid_jax.rotation import normalise
from hybrid_jax.sim.forces import DRAG_COEFFICIENT, Force, Parameters, Scalar, drag, ground_effect, parameters_of, wind
from hybrid_jax.sim.pilot import scale_of
from hybrid_jax.vehicle import BODY_RATES, IRIS, QUATERNION, VELOCITY, Input, State, Vehicle

CHUNK = 64  # flights per vmap; more would not fit into the cache of one core
_DERIVED: Any = None  # a default that depends on the vehicle


class Quadrotor(eqx.Module):
    """The true dynamics ẋ = f(x, u, t) of a vehicle under a sum of forces.

    Attributes:
        parameters: the vehicle's constants as arrays, which may be traced.
        forces: functions of `hybrid_jax.sim.forces`, or of your own, that add to thrust and gravity.
    """

    parameters: Parameters
    forces: tuple[Force, ...] = eqx.field(static=True)

    def derivative(self, x: State, u: Input, t: Scalar) -> State:
        """Return ẋ for the state x (13,) and rotor speeds u [rad/s].

        Args:
            t: time [s], for time-dependent forces, for example wind.
        """
        # Imported here, because MJX takes as long to import as JAX, and cached programs do not need it.
        from hybrid_jax.sim import scene

        wrenches = [jnp.concatenate(force(x, u, t, self.parameters)) for force in self.forces]
        applied = sum(wrenches, jnp.zeros_like(x, shape=6))
        turning = quaternion_derivative(x[QUATERNION], x[BODY_RATES])
        return jnp.concatenate([x[VELOCITY], turning, scene.accelerations(self.parameters, x, u, applied)])

    def step(self, x: State, u: Input, t: Scalar, dt: Scalar | float) -> State:
        """Return the state after one RK4 step from the state x (13,), with constant rotor speeds u [rad/s].

        Args:
            t: time at the start [s].
            dt: length of the step [s].
        """

        def stage(slope, fraction):
            slope = _derivative(self, x + fraction * dt * slope, u, t + fraction * dt)
            return slope, slope

        # A scan over the stages compiles several times faster than four copies of MJX. The first fraction is 0, so any
        # slope will do; for why it is not zeros, see `batching.like`.
        k1, k2, k3, k4 = jax.lax.scan(stage, x, jnp.array([0.0, 0.5, 0.5, 1.0], x.dtype))[1]
        end = x + dt / 6 * (k1 + 2 * (k2 + k3) + k4)
        return end.at[QUATERNION].set(normalise(end[QUATERNION]))


# Traced once for all calls of a program; the compiler inlines it again.
_derivative = eqx.filter_jit(Quadrotor.derivative)


@dataclass(frozen=True)
class Domain:
    """A simulated system: a vehicle and the forces on it beyond thrust and gravity.

    Attributes:
        name: name of the system. It should be unique, because simulated flights depend on it.
        vehicle: the true vehicle.
        drag_coefficient: C_D [kg/s]; by default the Iris's, scaled by the square of the vehicle's size.
        forces: functions of `hybrid_jax.sim.forces`, or of your own, that add to thrust and gravity.
        nominal: the vehicle that the pilot of random flights is tuned for; by default the true one.

    Raises:
        ValueError: if the vehicle is invalid, the drag is negative or not finite, or a force is not a function.
    """

    name: str
    vehicle: Vehicle = IRIS
    drag_coefficient: float = _DERIVED
    forces: tuple[Force, ...] = (drag, ground_effect)
    nominal: Vehicle = _DERIVED

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
        """Return the dynamics of the system, in the current precision."""
        return Quadrotor(parameters_of(self.vehicle, self.drag_coefficient), self.forces)

    def describe(self) -> dict[str, Any]:
        """Return the attributes as JSON values."""
        return {
            "domain": self.name,
            "vehicle": asdict(self.vehicle),
            "nominal": asdict(self.nominal),
            "drag_coefficient": self.drag_coefficient,
            "forces": [force.__name__ for force in self.forces],
        }


SOURCE = Domain("source")
"""The paper's quadrotor before the change, with drag and ground effect."""
PARAMETER_SHIFT = Domain("parameter_shift", vehicle=replace(IRIS, inertia=(0.04, 0.02, IRIS.inertia[2])), nominal=IRIS)
"""Another inertia [kg m²], as in Table 1 of the paper: Ix 0.02912 → 0.04000, Iy 0.02912 → 0.02000."""
EXTERNAL_FORCE = Domain("external_force", forces=(drag, ground_effect, wind))
"""A side wind of 4 N with a sine of 1 N."""
DOMAINS = {domain.name: domain for domain in (SOURCE, PARAMETER_SHIFT, EXTERNAL_FORCE)}
