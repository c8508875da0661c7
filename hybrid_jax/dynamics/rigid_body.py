"""f_p: the Newton–Euler equations of a multirotor with unknown Ix, Iy and k (paper, Eq. 10)."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.batching import expand_trailing
from hybrid_jax.dynamics.equations import derivative, evaluate_columns
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.rotation import Rows
from hybrid_jax.state import BODY_RATES, STATE_SIZE
from hybrid_jax.vehicle import Vehicle

LEARNED = ("Ix", "Iy", "k")


class AbstractRigidBody(AbstractVectorField):
    """A field whose state is that of state.py (13) and whose parameters have physical units."""

    accepts_batch: ClassVar[bool] = True

    def __check_init__(self):
        vehicle = getattr(self, "vehicle", None)
        if not isinstance(vehicle, Vehicle):
            raise ValueError(f"vehicle must be a Vehicle, got {checks.short_repr(vehicle)}")

    @abstractmethod
    def theta(self) -> dict[str, Array]:
        """The learned parameters in SI units, by name; each entry grows with the parameter that holds it."""


class RigidBody(AbstractRigidBody):
    """A rigid body carried by its rotors, with no drag, ground effect or wind.

    θ_p is held as log(value / nominal), so that one learning rate fits Ix ≈ 3e-2 and k ≈ 9e-6 and all stay positive.

    Raises:
        ValueError: other parameters than Ix, Iy, k, or no vehicle.
    """

    log_ratios: dict[str, Float[Array, ""]]  # log(Ix / nominal), log(Iy / nominal), log(k / nominal)
    vehicle: Vehicle = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.log_ratios, dict) or set(self.log_ratios) != set(LEARNED):
            raise ValueError(f"log_ratios must hold {', '.join(LEARNED)}, got {checks.short_repr(self.log_ratios)}")

    def theta(self) -> dict[str, Float[Array, ""]]:
        """θ_p in SI units: Ix, Iy [kg m²], k [N/(rad/s)²]."""
        return {name: value * jnp.exp(self.log_ratios[name]) for name, value in nominal(self.vehicle).items()}

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " rotors *b"]) -> Float[Array, " 13 *b"]:
        return self.of_rows(tuple(x), tuple(u))

    def train_batch(self, x, u):
        return evaluate_columns(RigidBody.of_rows, self, x, u)

    def of_rows(self, x: Rows, u: Rows) -> Float[Array, " 13 *b"]:
        return newton_euler(self.vehicle, self.theta(), x, u)


def newton_euler(vehicle: Vehicle, theta: dict[str, Array], x: Rows, u: Rows) -> Float[Array, " 13 *b"]:
    """ẋ of a rigid body with θ_p = {"Ix": …, "Iy": …, "k": …}."""
    return derivative(vehicle, Terms(), {name: (value,) for name, value in theta.items()}, x, u)


class ForcedBody(RigidBody):
    """A rigid body for which a residual is a force and a torque, not an acceleration.

    Its ω̇ holds at the nominal inertia and is scaled by nominal / I at another one, so that a learned aerodynamic torque
    remains valid when the inertia changes.
    """

    def apply_residual(self, x, residual):
        ratios = jnp.stack([jnp.exp(-self.log_ratios[name]) for name in ("Ix", "Iy")])
        factors = jnp.ones(STATE_SIZE, ratios.dtype).at[BODY_RATES.start : -1].set(ratios)
        return expand_trailing(factors, residual) * residual


def rigid_body(vehicle: Vehicle) -> RigidBody:
    """The rigid body at the vehicle's nominal θ_p."""
    return RigidBody({name: jnp.zeros(()) for name in LEARNED}, vehicle)


def perturbed(vehicle: Vehicle, key: PRNGKeyArray, *, low: float = 0.8, high: float = 1.25) -> RigidBody:
    """The rigid body with each of θ_p at nominal times a factor in [low, high], uniform in its logarithm."""
    if not 0 < low <= high < np.inf:
        raise ValueError(f"low and high must be two factors, 0 < low <= high, got {low} and {high}")
    factors = jax.random.uniform(key, (len(LEARNED),), minval=np.log(low), maxval=np.log(high))
    return RigidBody(dict(zip(LEARNED, factors, strict=True)), vehicle)


def perturbed_by(vehicle: Vehicle, key: PRNGKeyArray, off: float) -> RigidBody:
    """The rigid body with each of θ_p at nominal times or over 1 + off, at random."""
    signs = jax.random.rademacher(key, (len(LEARNED),), float)
    return RigidBody(dict(zip(LEARNED, np.log(1 + off) * signs, strict=True)), vehicle)


def moves_a_rigid_body(field) -> bool:
    """Whether a field contains a rigid body, so that its state is that of state.py."""
    parts = jax.tree.leaves(field, is_leaf=lambda node: isinstance(node, AbstractRigidBody))
    return any(isinstance(part, AbstractRigidBody) for part in parts)


def check_start(field, x0: Float[Array | np.ndarray, "*n 13"]) -> None:
    """Raise ValueError if an initial state of a rigid body holds no unit quaternion; accept states of other fields."""
    if x0.shape[-1:] == (STATE_SIZE,) and moves_a_rigid_body(field):
        checks.unit_quaternions("x0", x0)


def nominal(vehicle: Vehicle) -> dict[str, float]:
    """The vehicle's own Ix, Iy [kg m²] and k [N/(rad/s)²]."""
    return {"Ix": vehicle.inertia[0], "Iy": vehicle.inertia[1], "k": vehicle.thrust_coefficient}
