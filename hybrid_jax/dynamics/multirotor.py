"""f_p of a real multirotor: the rigid body with further terms, and with learned parameters chosen by name.

    ṗ = R (S Rᵀv + λ E f),   v̇ = R (T e_z / m + f) − g e_z,   J ω̇ = G τ − ω × J ω + A Rᵀv − B ω
    m f = C (τ_y, −τ_x, 0) − D Rᵀv,   E = diag(1, 1, 0)

T and τ are thrust and torque of the four rotors about a centre of mass that need not be the origin of their positions;
a rotor's thrust is k_i u_i², with one k or four. Linear rotor drag D, the moment A that grows with the velocity in the
body frame, and the damping B of the body rates: Faessler, Franchi and Scaramuzza, "Differential flatness of quadrotor
dynamics subject to rotor drag for accurate tracking of high-speed trajectories", 2018 (A there has the other sign). The
gain G scales the torque of the rotors, where it cannot be computed from their speeds. C models a cable that pulls at
1/C below the centre of mass: the state does not contain the position of the load, but the rotors' torque balances the
moment of the pull, and so reveals it.

S and λ describe the state estimator. Many assume that all force but gravity is along the body's z axis, and correct
their velocity v̂ for drag, wind or a cable by the position alone: d/dt v̂ = R T e_z / m − g e_z + (v − v̂) / λ across the
thrust. Then v − v̂ is λ times the force in the log, which is f and what a residual adds to it (`apply_residual`). The
gain S of each axis models the same for drag alone, and other errors of scale.

The lag of the rotors is not part of the field but applied to the log: as four more states, the rotor speeds would be
unknown at the start of each window, which is about as long as the lag. See `hybrid_jax.flights.cleaning`.
"""

from collections.abc import Callable
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks, rotation
from hybrid_jax.dynamics.rigid_body import LEARNED, AbstractRigidBody, euler, evaluate_columns
from hybrid_jax.dynamics.terms import POSITIVE, SHAPES, Terms, check_names, nominal_values, units_of
from hybrid_jax.rotation import Rows
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from hybrid_jax.vehicle import Vehicle

Constants = dict[str, Rows | tuple[float, ...]]  # name → entries: numbers if known, arrays if learned


class Multirotor(AbstractRigidBody):
    """The rigid body with `Terms`; with the default ones and names it is `RigidBody`.

    Parameters are deviations from nominal, so that all start at zero and one learning rate fits them all: positive ones
    as log(value / nominal), the others in units of the vehicle's weight and arm, at 1 m/s and 10 rad/s.

    Attributes:
        deviations: of each learned parameter, by name; shapes as in `SHAPES`.
        vehicle: the known constants and the nominal values.
        terms: the nominal values of the further terms; those that are zero and not learned cost nothing.

    Raises:
        ValueError: an unknown parameter name, both k and k_rotors, or no vehicle or terms.
    """

    accepts_batch: ClassVar[bool] = True

    deviations: dict[str, Float[Array, "..."]]
    vehicle: Vehicle = eqx.field(static=True)
    terms: Terms = eqx.field(static=True, default_factory=Terms)

    def __check_init__(self):
        if not isinstance(self.vehicle, Vehicle):
            raise ValueError(f"vehicle must be a Vehicle, got {checks.short_repr(self.vehicle)}")
        if not isinstance(self.terms, Terms):
            raise ValueError(f"terms must be Terms, got {checks.short_repr(self.terms)}")
        if not isinstance(self.deviations, dict):
            raise ValueError(f"deviations must be a dictionary, got {checks.short_repr(self.deviations)}")
        check_names(self.deviations)

    def theta(self) -> dict[str, Float[Array, "..."]]:
        """The learned parameters in SI units; see `Vehicle` and `Terms`."""
        nominal, units = nominal_values(self.vehicle, self.terms), units_of(self.vehicle)

        def value(name: str, deviation: Array) -> Array:
            middle = jnp.reshape(jnp.asarray(nominal[name], deviation.dtype), SHAPES[name])
            return middle * jnp.exp(deviation) if name in POSITIVE else middle + units[name] * deviation

        return {name: value(name, deviation) for name, deviation in self.deviations.items()}

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " 4 *b"]) -> Float[Array, " 13 *b"]:
        return self.of_rows(self.entries(), tuple(x), tuple(u))

    def train_batch(self, x, u):
        return evaluate_columns(self.of_rows, self.entries(), x, u)

    def apply_residual(self, x, residual):
        """A residual force, too, changes the position before it shows in the estimated velocity."""
        lag = _constants(self.vehicle, self.terms, self.entries())["velocity_lag"]
        if not _is_present(lag):
            return residual
        attitude = _matrix(tuple(x[QUATERNION]))
        across = [_dot(column, tuple(residual[VELOCITY])) for column in zip(*attitude, strict=True)][:2]
        return jnp.concatenate([residual[POSITION] + lag[0] * _in_world(attitude, across), residual[POSITION.stop :]])

    def entries(self) -> dict[str, Rows]:
        """θ_p number by number."""
        return {name: tuple(jnp.ravel(value)) for name, value in self.theta().items()}

    @property
    def of_rows(self) -> Callable[[dict[str, Rows], Rows, Rows], Float[Array, " 13 *b"]]:
        """ẋ as a function of the entries of θ_p, x and u, which spares stacking and unstacking them."""
        return partial(_of_rows, self.vehicle, self.terms)


def multirotor(vehicle: Vehicle, learn: tuple[str, ...] = LEARNED, terms: Terms | None = None) -> Multirotor:
    """The multirotor at its nominal values, which learns the parameters named in `learn`.

    Raises:
        ValueError: a name that is not in `SHAPES`, or k beside k_rotors.
    """
    check_names(learn)
    return Multirotor({name: jnp.zeros(SHAPES[name]) for name in learn}, vehicle, Terms() if terms is None else terms)


def with_vehicle(field: Multirotor, vehicle: Vehicle) -> Multirotor:
    """The field on another vehicle, such as the same one with a payload, with the same θ_p in SI units.

    Its deviations differ, as they are relative to the vehicle's nominal values, weight and arm.
    """
    nominal, units = nominal_values(vehicle, field.terms), units_of(vehicle)

    def deviation(name: str, value: Array) -> Array:
        middle = jnp.reshape(jnp.asarray(nominal[name], value.dtype), SHAPES[name])
        return jnp.log(value / middle) if name in POSITIVE else (value - middle) / units[name]

    return Multirotor({name: deviation(name, value) for name, value in field.theta().items()}, vehicle, field.terms)


def _constants(vehicle: Vehicle, terms: Terms, theta: dict[str, Rows]) -> Constants:
    """Everything in `SHAPES`: the learned value where there is one, else the nominal one."""
    known = nominal_values(vehicle, terms)
    return {name: theta.get(name, known[name]) for name in SHAPES}


def _of_rows(vehicle: Vehicle, terms: Terms, theta: dict[str, Rows], x: Rows, u: Rows) -> Float[Array, " 13 *b"]:
    constants = _constants(vehicle, terms, theta)
    q, v, omega = x[QUATERNION], x[VELOCITY], x[BODY_RATES]
    thrust, torque = _wrench(vehicle, constants, u)
    gravity = jnp.reshape(jnp.array([0.0, 0.0, -vehicle.gravity], thrust.dtype), (3,) + (1,) * thrust.ndim)
    acceleration = (thrust / vehicle.mass) * rotation.body_z(q) + gravity
    attitude = _matrix(q)
    velocity = [_dot(column, v) for column in zip(*attitude, strict=True)]
    force = _specific_force(vehicle, constants, velocity, torque)
    moved = _in_world(attitude, _faster(constants, velocity, force))
    inertia = tuple(constants[name][0] for name in ("Ix", "Iy", "Iz"))
    turned = rotation.derivative(q, omega), euler(inertia, _in_air(constants, velocity, omega, torque), omega)
    return jnp.concatenate([jnp.stack(v) + moved, turned[0], acceleration + _in_world(attitude, force), turned[1]])


def _specific_force(vehicle: Vehicle, constants: Constants, velocity, torque):
    """Specific force without thrust in the body frame [m/s²]: drag, and a cable that the rotors' torque balances."""
    drag, pull = constants["drag"], constants["cable_pull"]
    x, y, z = 0.0, 0.0, 0.0
    if _is_present(drag):
        x, y, z = (-(factor / vehicle.mass) * part for factor, part in zip(drag, velocity, strict=True))
    if _is_present(pull):
        x, y = x + pull[0] / vehicle.mass * torque[1], y - pull[1] / vehicle.mass * torque[0]
    return [x, y, z]


def _faster(constants: Constants, velocity, force):
    """ṗ less the estimated velocity, in the body frame [m/s]."""
    gain, lag = constants["velocity_gain"], constants["velocity_lag"]
    x, y, z = 0.0, 0.0, 0.0
    if _is_present(gain, absent=1.0):
        x, y, z = ((factor - 1.0) * part for factor, part in zip(gain, velocity, strict=True))
    if _is_present(lag):
        x, y = x + lag[0] * force[0], y + lag[0] * force[1]
    return [x, y, z]


def _in_air(constants: Constants, velocity, omega: Rows, torque):
    """The torque including aerodynamic moments."""
    moment, damping = constants["aerodynamic_moment"], constants["rate_damping"]
    if _is_present(moment):
        torque = [part + _dot(moment[3 * i : 3 * i + 3], velocity) for i, part in enumerate(torque)]
    if _is_present(damping):
        torque = [part - one * rate for part, one, rate in zip(torque, damping, omega, strict=True)]
    return torque


def _in_world(attitude, parts) -> Array | float:
    """A body vector, or its first entries where the others are zero, in the world frame."""
    return jnp.stack([_dot(row[: len(parts)], parts) for row in attitude]) if _is_present(parts) else 0.0


def _wrench(vehicle: Vehicle, constants: Constants, u: Rows):
    """Total thrust [N] and torque [N m] of the rotors about the centre of mass: thrust × arm, and c_m u²."""
    squares = [speed * speed for speed in u]
    (k,), of_rotors, gain = constants["k"], constants["k_rotors"], constants["torque_gain"]
    if isinstance(of_rotors[0], float):
        loads = squares
    else:
        k, loads = 1.0, [one * square for one, square in zip(of_rotors, squares, strict=True)]
    total = sum(loads[1:], loads[0])
    x, y = (_dot(arms, loads) for arms in zip(*vehicle.rotor_positions, strict=True))
    if _is_present(constants["centre_of_mass"]):
        x, y = (moment - offset * total for moment, offset in zip((x, y), constants["centre_of_mass"], strict=True))
    torque = [k * y, -k * x, constants["torque_coefficient"][0] * _dot(vehicle.spin, squares)]
    if _is_present(gain, absent=1.0):
        torque = [factor * part for factor, part in zip(gain, torque, strict=True)]
    return k * total, torque


def _matrix(q: Rows):
    """The rows of R, which turns body vectors into world vectors (scaled by |q|², as `rotation.rotate`)."""
    w, x, y, z = q
    return (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )


def _dot(a, b) -> Array:
    return sum(left * right for left, right in zip(a, b, strict=True))  # type: ignore


def _is_present(term, absent: float = 0.0) -> bool:
    """Whether a term is learned, or known and does something."""
    return any(not isinstance(number, float) or number != absent for number in term)
