"""Terms of a multirotor beyond the rigid body, and names, shapes and units of all learnable parameters."""

import math
from dataclasses import dataclass

import numpy as np

from hybrid_jax import checks
from hybrid_jax.vehicle import Vehicle, as_tuple, require_numbers

# m/s, m/s if the coefficient is of a square, and rad/s, at which a coefficient of 1 weighs as much as the vehicle.
SPEED, FAST, RATE = 1.0, 10.0, 10.0
POSITIVE = {"mass": (), "Ix": (), "Iy": (), "Iz": (), "k": (), "k_rotors": (4,), "torque_coefficient": ()}
SIGNED = {"torque_gain": (3,), "centre_of_mass": (2,), "drag": (3,), "cable_pull": (2,), "aerodynamic_moment": (3, 3)}
SIGNED |= {"rate_damping": (3,), "velocity_gain": (3,), "velocity_lag": (), "translational_lift": ()}
SIGNED |= {"rotor_drag": (3,)}
SHAPES = POSITIVE | SIGNED  # of all learnable parameters, for four rotors; see `shape_of`
OF_AIR = {"drag", "rotor_drag", "aerodynamic_moment", "translational_lift"}  # a wind acts through these
OF_VELOCITY = OF_AIR | {"velocity_lag", "velocity_gain"}  # not identifiable without a velocity
# Of a body that has changed; see `rigid_body.corrected`.
CORRECTIONS = {"efficiency": (4,), "reaction_torque": (), "mass_ratio": (), "centre_shift": (2,)}
CORRECTIONS |= {"added_drag": (3,), "wind": (3,)}
LOGARITHMIC = (*POSITIVE, "efficiency", "reaction_torque", "mass_ratio")
Three = tuple[float, float, float]
NONE = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Terms:
    """Nominal values of further terms of a `RigidBody`, in the body frame; all are absent by default.

    ValueError if a term has another shape, or a number is not finite.

    Attributes:
        torque_gain: factors G of the rotors' torque about x, y and z; 0 turns it off.
        centre_of_mass: (x, y) in the frame of the rotors' positions [m].
        drag: D along x, y and z [N s/m].
        cable_pull: C along x and y, the inverse of the distance below the centre of mass where a cable pulls [1/m].
        aerodynamic_moment: A, one row for each of the moments [N s].
        rate_damping: B about x, y and z [N m s].
        velocity_gain: S, the ratio of the position's derivative to the logged velocity.
        velocity_lag: λ, time constant of the estimated velocity for forces across the thrust [s].
        translational_lift: L, force of all rotors along z over the squared speed of their hubs along x and y [N s²/m²].
        rotor_drag: H of each rotor along x, y and z, at its hub, per its speed [N s²/m].
        motor_time_constant: lag of the rotors behind logged motor values [s]; applied to logs, not by the field.
    """

    torque_gain: Three = (1.0, 1.0, 1.0)
    centre_of_mass: tuple[float, float] = (0.0, 0.0)
    drag: Three = NONE
    cable_pull: tuple[float, float] = (0.0, 0.0)
    aerodynamic_moment: tuple[Three, Three, Three] = (NONE, NONE, NONE)
    rate_damping: Three = NONE
    velocity_gain: Three = (1.0, 1.0, 1.0)
    velocity_lag: float = 0.0
    translational_lift: float = 0.0
    rotor_drag: Three = NONE
    motor_time_constant: float = 0.0

    def __post_init__(self):
        for name, shape in SIGNED.items():
            what = f"a tuple of {shape[0]}{' of 3' if shape[1:] else ''}" if shape else "a finite number"
            require_numbers(name, getattr(self, name), shape, what)
            object.__setattr__(self, name, as_tuple(np.asarray(getattr(self, name), float).tolist()))
        checks.not_negative("motor_time_constant", self.motor_time_constant)


def check_names(learn: tuple[str, ...], also: tuple[str, ...] = ()) -> None:
    """Raise ValueError for names not in `SHAPES` or `also`, given twice, or not identifiable together."""
    if not isinstance(learn, tuple) or not all(isinstance(name, str) for name in learn):
        raise ValueError(f"learn must be a list of names, got {checks.short_repr(learn)}")
    known = (*SHAPES, *also)
    for name in learn:
        if name not in known:
            raise ValueError(f"learn must be names of {', '.join(known)}, got {checks.short_repr(name)}")
    if len(set(learn)) != len(learn):
        raise ValueError(f"learn must not name a parameter twice, got {', '.join(learn)}")
    if {"k", "k_rotors"} <= set(learn):
        raise ValueError("learn must not name both k and k_rotors: both contain the factor common to all rotors")
    if "mass" in learn and (other := {"k", "k_rotors"} & set(learn)):
        raise ValueError(f"learn must not name both mass and {other.pop()}: only their ratio is identifiable")


def shape_of(vehicle: Vehicle, name: str) -> tuple[int, ...]:
    return (vehicle.rotors,) if name in ("k_rotors", "efficiency") else (SHAPES | CORRECTIONS)[name]


def nominal_values(vehicle: Vehicle, terms: Terms) -> dict[str, tuple[float, ...]]:
    """Return the nominal values [SI units] of everything in `SHAPES` and `CORRECTIONS`, number by number."""
    k, (ix, iy, iz) = vehicle.thrust_coefficient, vehicle.inertia
    own = {"Ix": (ix,), "Iy": (iy,), "Iz": (iz,), "k": (k,), "k_rotors": (k,) * vehicle.rotors}
    own |= {"mass": (vehicle.mass,), "torque_coefficient": (vehicle.torque_coefficient,)}
    own |= {"efficiency": (1.0,) * vehicle.rotors, "reaction_torque": (1.0,), "mass_ratio": (1.0,)}
    own |= {"centre_shift": (0.0, 0.0), "added_drag": NONE, "wind": NONE}
    return own | {name: tuple(np.ravel(getattr(terms, name)).tolist()) for name in SIGNED}


def units_of(vehicle: Vehicle) -> dict[str, float]:
    """Return the SI value of a deviation of 1: forces and moments in the vehicle's weight and weight × arm."""
    weight = vehicle.mass * vehicle.gravity
    arm = sum(math.hypot(*place) for place in vehicle.rotor_positions) / vehicle.rotors
    forces = {"drag": weight / SPEED, "aerodynamic_moment": weight * arm / SPEED, "rate_damping": weight * arm / RATE}
    forces["translational_lift"] = weight / FAST**2
    forces["rotor_drag"] = weight / SPEED / (vehicle.rotors * vehicle.hover_speed)
    places = {"centre_of_mass": arm, "centre_shift": arm, "cable_pull": 1 / arm}
    return dict.fromkeys((*CORRECTIONS, "torque_gain", "velocity_gain", "velocity_lag"), 1.0) | forces | places
