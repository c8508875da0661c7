"""f_p of a real multirotor: the rigid body with further terms, and with learned parameters chosen by name."""

from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics import equations
from hybrid_jax.dynamics.rigid_body import LEARNED, AbstractRigidBody
from hybrid_jax.dynamics.terms import POSITIVE, Terms, check_names, nominal_values, shape_of, units_of
from hybrid_jax.rotation import Rows
from hybrid_jax.state import POSITION, QUATERNION, VELOCITY
from hybrid_jax.vehicle import Vehicle


class Multirotor(AbstractRigidBody):
    """The rigid body with `Terms`; with the default ones and names it is `RigidBody`.

        ṗ = R (S Rᵀv + λ E f),   v̇ = R (T e_z / m + f) − g e_z,   J ω̇ = G τ − ω × J ω + A Rᵀv − B ω
        m f = C (τ_y, −τ_x, 0) − D Rᵀv,   E = diag(1, 1, 0)

    T and τ are thrust and torque of the rotors about the centre of mass; a rotor's thrust is k_i u_i², with one k or
    one for each, and G scales the torque where the speeds do not tell it. Rotor drag D, the moment A and the damping B:
    Faessler, Franchi and Scaramuzza, "Differential flatness of quadrotor dynamics subject to rotor drag for accurate
    tracking of high-speed trajectories", 2018 (A there has the other sign). C is a cable that pulls at 1/C below the
    centre of mass: the state does not hold the load's position, but the torque that balances its moment reveals it.

    S and λ describe a state estimator that takes all force but gravity to be along the body's z axis, and corrects its
    velocity v̂ for other forces by the position alone: d/dt v̂ = R T e_z / m − g e_z + (v − v̂) / λ across the thrust.
    Then v − v̂ is λ times the force in the log: f and what a residual adds to it. S models the same for drag alone.

    Parameters are deviations from nominal, so that all start at zero and one learning rate fits them all: positive ones
    as log(value / nominal), the others in units of the vehicle's weight and arm, at 1 m/s and 10 rad/s. The lag of the
    rotors is applied to the log (`hybrid_jax.flights.checks.cleaning`): as four more states it would be unknown at the
    start of each window.

    Attributes:
        deviations: of each learned parameter, by name; shapes as of `shape_of`.
        terms: nominal values; those that are zero and not learned cost nothing.

    Raises:
        ValueError: an unknown parameter name, two that only their ratio or product tells, or no vehicle or terms.
    """

    deviations: dict[str, Float[Array, "..."]]
    vehicle: Vehicle = eqx.field(static=True)
    terms: Terms = eqx.field(static=True, default_factory=Terms)

    def __check_init__(self):
        if not isinstance(self.terms, Terms):
            raise ValueError(f"terms must be Terms, got {checks.short_repr(self.terms)}")
        if not isinstance(self.deviations, dict):
            raise ValueError(f"deviations must be a dictionary, got {checks.short_repr(self.deviations)}")
        check_names(tuple(self.deviations))

    def theta(self) -> dict[str, Float[Array, "..."]]:
        """The learned parameters in SI units; see `Vehicle` and `Terms`."""
        units = units_of(self.vehicle)

        def value(name: str, deviation: Array) -> Array:
            middle = _nominal(self.vehicle, self.terms, name, deviation.dtype)
            return middle * jnp.exp(deviation) if name in POSITIVE else middle + units[name] * deviation

        return {name: value(name, deviation) for name, deviation in self.deviations.items()}

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " rotors *b"]) -> Float[Array, " 13 *b"]:
        return equations.derivative(self.vehicle, self.terms, self.entries(), tuple(x), tuple(u))

    def train_batch(self, x, u):
        of_rows = partial(equations.derivative, self.vehicle, self.terms)
        return equations.evaluate_columns(of_rows, self.entries(), x, u)

    def apply_residual(self, x, residual):
        """A residual force, too, changes the position before it shows in the estimated velocity."""
        lag = self.entries().get("velocity_lag", (self.terms.velocity_lag,))
        if not equations.is_present(lag):
            return residual
        attitude = equations.attitude_matrix(tuple(x[QUATERNION]))
        across = [equations.dot(column, tuple(residual[VELOCITY])) for column in zip(*attitude, strict=True)][:2]
        position = residual[POSITION] + lag[0] * equations.in_world(attitude, across)
        return jnp.concatenate([position, residual[POSITION.stop :]])

    def entries(self) -> dict[str, Rows]:
        """θ_p number by number."""
        return {name: tuple(jnp.ravel(value)) for name, value in self.theta().items()}


def multirotor(vehicle: Vehicle, learn: tuple[str, ...] = LEARNED, terms: Terms | None = None) -> Multirotor:
    """The multirotor at its nominal values, which learns the parameters named in `learn`; see `check_names`."""
    check_names(tuple(learn))
    deviations = {name: jnp.zeros(shape_of(vehicle, name)) for name in learn}
    return Multirotor(deviations, vehicle, Terms() if terms is None else terms)


def with_vehicle(field: Multirotor, vehicle: Vehicle) -> Multirotor:
    """The field on another vehicle, such as the same one with a payload, with the same θ_p in SI units.

    Its deviations differ, as they are relative to the vehicle's nominal values, weight and arm.
    """
    units = units_of(vehicle)

    def deviation(name: str, value: Array) -> Array:
        middle = _nominal(vehicle, field.terms, name, value.dtype)
        return jnp.log(value / middle) if name in POSITIVE else (value - middle) / units[name]

    return Multirotor({name: deviation(name, value) for name, value in field.theta().items()}, vehicle, field.terms)


def _nominal(vehicle: Vehicle, terms: Terms, name: str, dtype) -> Array:
    return jnp.reshape(jnp.asarray(nominal_values(vehicle, terms)[name], dtype), shape_of(vehicle, name))
