"""f_p: the Newton–Euler equations of a quadrotor with unknown Ix, Iy and k (paper, Eq. 10)."""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from hybrid_jax import checks, rotation
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.batching import expand_trailing
from hybrid_jax.rotation import Rows
from hybrid_jax.state import BODY_RATES, QUATERNION, STATE_SIZE, VELOCITY
from hybrid_jax.vehicle import Vehicle

LEARNED = ("Ix", "Iy", "k")


class AbstractRigidBody(AbstractVectorField):
    """A field whose state is that of state.py (13) and whose parameters have physical units."""

    @abstractmethod
    def theta(self) -> dict[str, Array]:
        """The learned parameters in SI units, by name; each entry grows with the parameter that holds it."""


class RigidBody(AbstractRigidBody):
    """A rigid body carried by four rotors, with no drag, ground effect or wind.

    θ_p is held as log(value / nominal), so that one learning rate fits Ix ≈ 3e-2 and k ≈ 9e-6 and all stay positive.
    Attributes:
        log_ratios: log(Ix / nominal), log(Iy / nominal), log(k / nominal).
        vehicle: the known constants and the nominal values.

    Raises:
        ValueError: other parameters than Ix, Iy, k, or no vehicle.
    """

    accepts_batch: ClassVar[bool] = True

    log_ratios: dict[str, Float[Array, ""]]
    vehicle: Vehicle = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.log_ratios, dict) or set(self.log_ratios) != set(LEARNED):
            raise ValueError(f"log_ratios must hold {', '.join(LEARNED)}, got {checks.short_repr(self.log_ratios)}")
        if not isinstance(self.vehicle, Vehicle):
            raise ValueError(f"vehicle must be a Vehicle, got {checks.short_repr(self.vehicle)}")

    def theta(self) -> dict[str, Float[Array, ""]]:
        """θ_p in SI units: Ix, Iy [kg m²], k [N/(rad/s)²]."""
        return {name: value * jnp.exp(self.log_ratios[name]) for name, value in nominal(self.vehicle).items()}

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " 4 *b"]) -> Float[Array, " 13 *b"]:
        return self.of_rows(tuple(x), tuple(u))

    def train_batch(self, x, u):
        return evaluate_columns(RigidBody.of_rows, self, x, u)

    def of_rows(self, x: Rows, u: Rows) -> Float[Array, " 13 *b"]:
        """ẋ from the entries of x and u, which spares stacking and unstacking them."""
        q, v, omega = x[QUATERNION], x[VELOCITY], x[BODY_RATES]
        theta = self.theta()
        thrust, torque = _wrench(self.vehicle, theta["k"], u)
        gravity = jnp.reshape(jnp.array([0.0, 0.0, -self.vehicle.gravity], thrust.dtype), (3,) + (1,) * thrust.ndim)
        acceleration = (thrust / self.vehicle.mass) * rotation.body_z(q) + gravity
        inertia = (theta["Ix"], theta["Iy"], self.vehicle.inertia[2])
        return jnp.concatenate(
            [jnp.stack(v), rotation.derivative(q, omega), acceleration, euler(inertia, torque, omega)]
        )


class ForcedBody(RigidBody):
    """A rigid body for which a residual is a force and a torque, not an acceleration.

    The residual's v̇ and ω̇ hold at the nominal inertia; at another one, its ω̇ is scaled by nominal / I. So a learned
    aerodynamic torque remains valid when the inertia changes. The mass is known.
    """

    def yielding(self) -> Float[Array, " 13"]:
        """The factors of a residual's ẋ: nominal / I for ω̇ about x and y, else 1."""
        easier = [jnp.exp(-self.log_ratios[name]) for name in ("Ix", "Iy")]
        return jnp.ones(STATE_SIZE, jnp.result_type(*easier)).at[BODY_RATES.start : -1].set(jnp.stack(easier))

    def apply_residual(self, x, residual):
        return expand_trailing(self.yielding(), residual) * residual


def rigid_body(vehicle: Vehicle) -> RigidBody:
    """The rigid body at the vehicle's nominal θ_p."""
    return RigidBody({name: jnp.zeros(()) for name in LEARNED}, vehicle)


def perturbed(vehicle: Vehicle, key: PRNGKeyArray, *, low: float = 0.8, high: float = 1.25) -> RigidBody:
    """The rigid body with each of θ_p at nominal times a random factor in [low, high], uniform in its logarithm.

    Raises:
        ValueError: not 0 < low <= high.
    """
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
    """Check that initial states of a rigid body hold unit quaternions; accept any state of another field.

    Raises:
        ValueError: the index of the first quaternion that is not of unit norm, and its norm.
    """
    if x0.shape[-1:] == (STATE_SIZE,) and moves_a_rigid_body(field):
        checks.unit_quaternions("x0", x0)


def nominal(vehicle: Vehicle) -> dict[str, float]:
    """The vehicle's own Ix, Iy [kg m²] and k [N/(rad/s)²]."""
    return {"Ix": vehicle.inertia[0], "Iy": vehicle.inertia[1], "k": vehicle.thrust_coefficient}


def _wrench(vehicle: Vehicle, k: Float[Array, ""], u: Rows):
    """Total thrust [N] and body torque [N m] of the rotors: thrust × arm, and the reaction torque c_m u²."""
    squares = [speed * speed for speed in u]

    def total(weights):
        return sum(weight * square for weight, square in zip(weights, squares, strict=True))

    x, y = zip(*vehicle.rotor_positions, strict=True)
    torque = k * total(y), -k * total(x), vehicle.torque_coefficient * total(vehicle.spin)
    return k * sum(squares), torque


def euler(inertia, torque, omega: Rows) -> Float[Array, " 3 *b"]:
    """ω̇ = J⁻¹ (τ − ω × J ω) for J = diag(Ix, Iy, Iz)."""
    (ix, iy, iz), (tx, ty, tz), (wx, wy, wz) = inertia, torque, omega
    return jnp.stack(
        [(tx - (iz - iy) * wy * wz) / ix, (ty - (ix - iz) * wz * wx) / iy, (tz - (iy - ix) * wx * wy) / iz]
    )


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def evaluate_columns(
    of_rows: Callable[[PyTree, Rows, Rows], Float[Array, "13 b"]],
    theta: PyTree,
    x: Float[Array, "13 b"],
    u: Float[Array, "4 b"],
) -> Float[Array, "13 b"]:
    """`of_rows(theta, x, u)` on a minibatch, for scalar parameters.

    Autodiff would keep some thirty rows of each evaluation for the way back and sum each parameter's derivative over
    the minibatch once for each place where it stands. Here x and u are kept, and each parameter is summed once.
    """
    return of_rows(theta, tuple(x), tuple(u))


def _columns_forward(of_rows, theta, x, u):
    return of_rows(theta, tuple(x), tuple(u)), (theta, x, u)


def _columns_backward(of_rows, saved, d_derivative: Float[Array, "13 b"]):
    theta, x, u = saved
    own = jax.tree.map(lambda parameter: jnp.broadcast_to(parameter, x.shape[1:]), theta)  # one for each column
    d_own, d_x, d_u = jax.vjp(of_rows, own, tuple(x), tuple(u))[1](d_derivative)
    leaves, structure = jax.tree.flatten(d_own)
    if leaves:
        leaves = tuple(jnp.stack(leaves) @ jnp.ones(x.shape[1:], x.dtype))
    return jax.tree.unflatten(structure, leaves), jnp.stack(d_x), jnp.stack(d_u)


evaluate_columns.defvjp(_columns_forward, _columns_backward)
