"""f_p: the Newton–Euler equations of a multirotor, by default with unknown Ix, Iy and k (paper, Eq. 10); baselines."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax import checks, rotation
from hybrid_jax.dynamics import equations
from hybrid_jax.dynamics.base import AbstractVectorField, parts_of
from hybrid_jax.dynamics.batching import expand_trailing
from hybrid_jax.dynamics.composition import AbstractWrapper
from hybrid_jax.dynamics.terms import CORRECTIONS, LOGARITHMIC, Terms, check_names, nominal_values, shape_of, units_of
from hybrid_jax.rotation import Rows
from hybrid_jax.state_space import Attitude, Quantity, StateSpace
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, STATE_NAMES, STATE_SIZE, VELOCITY, Vehicle

LEARNED = ("Ix", "Iy", "k")
UNITS = {"Ix": "kg m²", "Iy": "kg m²", "Iz": "kg m²", "k": "N s²", "k_rotors": "N s²", "torque_coefficient": "N m s²"}
UNITS |= {"mass": "kg", "centre_of_mass": "m", "drag": "N s/m", "cable_pull": "1/m", "aerodynamic_moment": "N s"}
UNITS |= {"centre_shift": "m", "added_drag": "1/s", "rate_damping": "N m s", "velocity_lag": "s", "wind": "m/s"}
UNITS |= {"translational_lift": "N s²/m²", "rotor_drag": "N s²/m"}
INERTIAS = {"mass": VELOCITY, "mass_ratio": VELOCITY}
INERTIAS |= {name: BODY_RATES.start + i for i, name in enumerate(("Ix", "Iy", "Iz"))}


@dataclass(frozen=True)
class RigidBodySpace(StateSpace):
    """The state space of a multirotor: position, attitude, velocity and body rates; see `RIGID_BODY_SPACE`."""

    def features(self, x, u):
        lengths = {"speed [m/s]": x[:, VELOCITY], "body rates [rad/s]": x[:, BODY_RATES]}
        norms = {name: (each**2).sum(axis=1) ** 0.5 for name, each in lengths.items()}
        return norms | {"rotor speed [rad/s]": u.ravel(), "tilt [rad]": rotation.tilt(x[:, QUATERNION])}


RIGID_BODY_SPACE = RigidBodySpace(
    (
        Quantity("position", 3, "m", STATE_NAMES[POSITION]),
        Attitude("attitude", labels=STATE_NAMES[QUATERNION]),
        Quantity("velocity", 3, "m/s", STATE_NAMES[VELOCITY]),
        Quantity("body rates", 3, "rad/s", STATE_NAMES[BODY_RATES]),
    ),
    disturbed=slice(VELOCITY.start, STATE_SIZE),  # ṗ and q̇ follow from v and ω exactly
)


class RigidBody(AbstractVectorField):
    """A rigid body carried by its rotors, with further `Terms`; x (13) and u are as in `hybrid_jax.vehicle`.

        ṗ = R (S Rᵀv + λ E f),   v̇ = R (T e_z / m + f) − g e_z,   J ω̇ = G τ − ω × J ω + A Rᵀv − B ω
        m f = C (τ_y, −τ_x, 0) − D Rᵀv − m c Rᵀv + Σ d_i,   E = diag(1, 1, 0)
        d_i = −u_i H v_i + L/n ‖E v_i‖² e_z,   v_i = Rᵀv + ω × r_i, which also adds the torque Σ r_i × d_i

    T and τ are thrust and torque of the rotors about the centre of mass. A rotor's thrust is k_i u_i², with the same or
    different k_i, and G scales the torque where the speeds do not determine it. For rotor drag D, the moment A and the
    damping B see Faessler, Franchi and Scaramuzza, "Differential flatness of quadrotor dynamics subject to rotor drag
    for accurate tracking of high-speed trajectories", 2018 (A has the other sign there). C is a cable that pulls at 1/C
    below the centre of mass. The state lacks the load's position, but the torque that balances its moment reveals it.
    The hub r_i of each of n rotors moves at v_i. L/n is its translational lift, for its speed ‖E v_i‖ across its axis,
    and H its drag, which grows with its speed u_i; near hover it acts like D = Σ u_i H and a damping. See
    Svacha, Mohta and Kumar, "Improving quadrotor trajectory tracking by compensating for aerodynamic effects", 2017.

    S and λ describe a state estimator that assumes that all force but gravity is along the body's z axis, and corrects
    its velocity v̂ for other forces only by the position: d/dt v̂ = R T e_z / m − g e_z + (v − v̂) / λ across the thrust.
    Then v − v̂ is λ times the force in the log: f plus the residual. S models the same for drag only.

    Corrections describe a change of the body (`corrected`): `efficiency` e, a rotor's thrust and reaction torque
    relative to an intact rotor at the same speed; `reaction_torque`, a factor of all reaction torques, for example for
    other propellers; `mass_ratio`, a factor of m, and `centre_shift` [m], a shift of the centre of mass along x and y,
    both of a load; `added_drag` c [1/s] along the body's axes; and `wind` w [m/s, world], for a body with D, H, A or L:
    all but ṗ are then those at v − w.

    Parameters are deviations from nominal that start at zero, so that one learning rate fits all: positive ones as
    log(value / nominal), the others in units of the vehicle's weight and arm, at 1 m/s and 10 rad/s. The lag of the
    rotors is applied to the log instead (`hybrid_jax.flights.checks.cleaning`), because their speeds as states would
    be unknown at the start of each window.

    Attributes:
        deviations: the deviation of each learned parameter from nominal, by name; for shapes see `shape_of`.
        vehicle: the constants of the vehicle, which are the nominal values.
        terms: nominal values of further terms; those that are zero and not learned cost nothing.
        wrench: whether a residual is a force and a torque instead of an acceleration. Its v̇ and ω̇ are then valid at
            nominal mass and inertia, and scaled by nominal / m and nominal / I. For example, a learned aerodynamic
            torque remains valid when the inertia changes.

    Raises:
        ValueError: if a name is unknown, only a ratio or product of two parameters is identifiable, or a type is wrong.
    """

    accepts_batch: ClassVar[bool] = True

    deviations: dict[str, Float[Array, "..."]]
    vehicle: Vehicle = eqx.field(static=True)
    terms: Terms = eqx.field(static=True, default_factory=Terms)
    wrench: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        checks.instance("vehicle", self.vehicle, Vehicle)
        checks.instance("terms", self.terms, Terms)
        checks.instance("deviations", self.deviations, dict)
        check_names(tuple(name for name in self.deviations if name not in CORRECTIONS))

    @property
    def state_space(self):
        return RIGID_BODY_SPACE

    @property
    def parameter_units(self):
        return UNITS

    def theta(self) -> dict[str, Float[Array, "..."]]:
        """Return the learned parameters in SI units, by name; see `Vehicle` and `Terms`."""
        shapes = {name: shape_of(self.vehicle, name) for name, each in self.deviations.items() if not _is_held(each)}
        entries = self.entries()
        return {name: jnp.stack(entries[name]).reshape(at) if at else entries[name][0] for name, at in shapes.items()}

    def entries(self, *names: str) -> dict[str, Rows]:
        """Return the numbers of θ_p.

        Args:
            names: the parameters that you need; by default all. Those that are not learned are left out.
        """
        units, known = units_of(self.vehicle), nominal_values(self.vehicle, self.terms)

        def value(name: str, middle: float, deviation: Array) -> Array:
            return middle * jnp.exp(deviation) if name in LOGARITHMIC else middle + units[name] * deviation

        def values(name: str, deviation) -> Rows:
            if not isinstance(deviation, tuple):
                deviation = tuple(jnp.ravel(deviation)) if shape_of(self.vehicle, name) else (deviation,)
            return tuple(value(name, *pair) for pair in zip(known[name], deviation, strict=True))

        learned = sorted(self.deviations.keys() & set(names or self.deviations))
        return {name: values(name, self.deviations[name]) for name in learned}

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " rotors *b"]) -> Float[Array, " 13 *b"]:
        return self.of_rows(tuple(x), tuple(u))

    def train_batch(self, x, u):
        by_number = jax.tree.map(lambda leaf: tuple(jnp.ravel(leaf)) if jnp.ndim(leaf) else leaf, self)
        return equations.evaluate_columns(RigidBody.of_rows, by_number, x, u)

    def of_rows(self, x: Rows, u: Rows) -> Float[Array, " 13 *b"]:
        """Compute ẋ from the entries of x and u."""
        if (len(x), len(u)) != (sizes := (STATE_SIZE, len(self.vehicle.rotor_positions))):
            raise ValueError(f"x and u must have {sizes[0]} and {sizes[1]} numbers, got {len(x)} and {len(u)}")
        return equations.derivative(self.vehicle, self.terms, self.entries(), x, u)

    def apply_residual(self, x, residual):
        """Return the residual with its effect on ṗ: a force changes the position before the estimated velocity."""
        if self.wrench:
            factors = jnp.ones(STATE_SIZE, residual.dtype)
            for name, at in INERTIAS.items():
                factors = factors.at[at].set(jnp.exp(-self.deviations[name])) if name in self.deviations else factors
            residual = expand_trailing(factors, residual) * residual
        lag = self.entries("velocity_lag").get("velocity_lag", (self.terms.velocity_lag,))
        if not equations.is_present(lag):
            return residual
        attitude = rotation.matrix(tuple(x[QUATERNION]))
        across = [equations.dot(column, tuple(residual[VELOCITY])) for column in zip(*attitude, strict=True)][:2]
        position = residual[POSITION] + lag[0] * equations.in_world(attitude, across)
        return jnp.concatenate([position, residual[POSITION.stop :]])


def rigid_body(
    vehicle: Vehicle, learn: tuple[str, ...] = LEARNED, terms: Terms | None = None, wrench: bool = False
) -> RigidBody:
    """Make a rigid body at its nominal values.

    Args:
        vehicle: its constants.
        learn: names of the learned parameters, from `terms.SHAPES`.
        terms: nominal values of terms beyond thrust, torque and weight; by default none.
        wrench: whether its residual is a force and a torque, see `RigidBody`.

    Raises:
        ValueError: if names are unknown, given twice, or not identifiable together.
    """
    check_names(tuple(learn))
    deviations = {name: jnp.zeros(shape_of(vehicle, name)) for name in learn}
    return RigidBody(deviations, vehicle, Terms() if terms is None else terms, wrench)


def perturbed(vehicle: Vehicle, key: PRNGKeyArray, *, low: float = 0.8, high: float = 1.25) -> RigidBody:
    """Return a rigid body with each of θ_p at nominal times a random factor, log-uniform from low to high."""
    if not 0 < low <= high < np.inf:
        raise ValueError(f"low and high must be two factors, 0 < low <= high, got {low} and {high}")
    factors = jax.random.uniform(key, (len(LEARNED),), minval=np.log(low), maxval=np.log(high))
    return RigidBody(dict(zip(LEARNED, factors, strict=True)), vehicle)


def corrected(field: AbstractVectorField, names: Iterable[str] = CORRECTIONS) -> AbstractVectorField:
    """Return the field with corrections of its rigid bodies, initially without effect, unless it has any already."""

    def larger(body: RigidBody) -> RigidBody:
        dtype = jnp.result_type(*jax.tree.leaves(body) or [float])
        told = equations.feels_wind(body.vehicle, body.terms, body.deviations)
        zero = {name: jnp.zeros(shape_of(body.vehicle, name), dtype) for name in names if told or name != "wind"}
        return body if body.deviations.keys() & CORRECTIONS else replace(body, deviations=body.deviations | zero)

    return _with_bodies(field, larger)


def uncorrected(field: AbstractVectorField) -> AbstractVectorField:
    """Return the field without corrections if all are zero; outside of compiled code."""

    def smaller(body: RigidBody) -> RigidBody:
        kept = {name: value for name, value in body.deviations.items() if name not in CORRECTIONS}
        used = any(np.asarray(body.deviations.get(name, 0)).any() for name in CORRECTIONS)
        return body if used else replace(body, deviations=kept)

    return _with_bodies(field, smaller)


def hold_corrections(field: AbstractVectorField) -> AbstractVectorField:
    """Return the field with its corrections as constants instead of parameters; outside of compiled code."""

    def held(body: RigidBody) -> RigidBody:
        given = {name: body.deviations[name] for name in CORRECTIONS if name in body.deviations}
        known = {name: tuple(np.ravel(deviation).tolist()) for name, deviation in given.items()}
        return replace(body, deviations={**body.deviations, **known})  # Python numbers are constants

    return _with_bodies(field, held)


def _is_held(deviation: Any) -> bool:
    return isinstance(deviation, tuple) and not any(map(eqx.is_array, deviation))


def _with_bodies(field: AbstractVectorField, change: Callable[[RigidBody], RigidBody]) -> AbstractVectorField:
    bodies = {"is_leaf": lambda node: isinstance(node, RigidBody)}
    return jax.tree.map(lambda node: change(node) if isinstance(node, RigidBody) else node, field, **bodies)


def nominal(vehicle: Vehicle) -> dict[str, float]:
    """Return the vehicle's own Ix, Iy [kg m²] and k [N/(rad/s)²]."""
    return {"Ix": vehicle.inertia[0], "Iy": vehicle.inertia[1], "k": vehicle.thrust_coefficient}


class Kinematics(AbstractVectorField):
    """ṗ = v and q̇ = ½ q ⊗ [0, ω] with v̇ = ω̇ = 0: exact kinematics without knowledge of forces."""

    accepts_batch: ClassVar[bool] = True

    @property
    def state_space(self):
        return RIGID_BODY_SPACE

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " rotors *b"]) -> Float[Array, " 13 *b"]:
        accelerations = jnp.zeros((6, *x.shape[1:]), x.dtype)
        return jnp.concatenate([x[VELOCITY], rotation.derivative(x[QUATERNION], x[BODY_RATES]), accelerations])


class FrozenRates(AbstractWrapper):
    """A baseline with ω̇ = 0: thrust accelerates the vehicle, and its body rates stay constant."""

    def write(self, x, inside):
        return inside.at[BODY_RATES].set(0.0)


def vehicle_in(field: Any) -> Vehicle | None:
    vehicles = (getattr(part, "vehicle", None) for part in parts_of(field))
    return next((one for one in vehicles if isinstance(one, Vehicle)), None)
