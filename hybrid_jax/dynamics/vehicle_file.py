"""A vehicle file: constants of the vehicle, nominal values of further terms, and the learned parameters.

Above all tables `learn = ["Ix", "drag", …]`, names from `terms.SHAPES`; then `[vehicle]` with constants of `Vehicle`,
`[vehicle.NAME]` with the overrides of a variant, `[terms]` with nominal values of `Terms`, and, for logs of commands
instead of rotor speeds, `[actuator]` with values of `Actuator`, whose names you can add to `learn`.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hybrid_jax import checks
from hybrid_jax.dynamics.actuators import NAMES, Actuated, Actuator, actuated, check_actuator_names
from hybrid_jax.dynamics.rigid_body import RigidBody, rigid_body
from hybrid_jax.dynamics.terms import Terms, check_names
from hybrid_jax.vehicle import TABLES, Vehicle, from_table, read_tables, require_known, vehicle_of

# The default of `learn`. Without the aerodynamics, inertia would absorb a part of them.
LEARN = ("Ix", "Iy", "Iz", "k_rotors", "rate_damping", "drag", "aerodynamic_moment")
LAG = "motor_time_constant"  # learned from the logs and not by a field: see `hybrid_jax.flights.checks.cleaning`


@dataclass(frozen=True)
class VehicleModel:
    """A vehicle and the names of its parameters to learn; ValueError if a name is unknown.

    Attributes:
        vehicle: its constants.
        terms: nominal values of further terms.
        actuator: the map from command to rotor speed; None for logs of rotor speeds.
        learn: names from `terms.SHAPES`, and "motor_time_constant" for the rotors' lag in logs.
    """

    vehicle: Vehicle
    terms: Terms = field(default_factory=Terms)
    actuator: Actuator | None = None
    learn: tuple[str, ...] = LEARN

    def __post_init__(self):
        check_learned(self.learn, self.actuator)

    def physics(self) -> RigidBody:
        """Return the field at its nominal values, driven by rotor speeds."""
        learned = tuple(name for name in self.learn if name != LAG and name not in NAMES)
        return rigid_body(self.vehicle, learned, self.terms)

    def commanded(self) -> Actuated:
        """Return the field at its nominal values, driven by commands; ValueError if there is no `[actuator]`."""
        if self.actuator is None:
            raise ValueError("the vehicle file has no table [actuator], which a log of commands needs")
        return actuated(self.physics(), self.actuator, tuple(name for name in self.learn if name in NAMES))


def check_learned(learn: tuple[str, ...], actuator: Actuator | None = None) -> None:
    """Raise ValueError for names that are unknown or exclude each other."""
    check_names(learn, also=(LAG, *(NAMES if actuator else ())))
    if actuator:
        check_actuator_names(tuple(name for name in learn if name in NAMES), actuator, learn)


def load_vehicle_model(path: str | Path, variant: str | None = None) -> VehicleModel:
    """Read a vehicle file: TOML with `[vehicle]`, `learn` (above all tables, by default `LEARN`) and `[terms]`.

    Args:
        path: the TOML file.
        variant: name of a table `[vehicle.VARIANT]` that overrides constants, for example the mass with a payload.

    Raises:
        ValueError: if a key is invalid, with the file, the key and what was expected.
    """
    tables = read_tables(path)
    require_known(str(path), tables, TABLES)
    if isinstance(vehicle := tables.get("vehicle"), dict) and "learn" in vehicle:
        raise ValueError(f"{path}: [vehicle]: learn must be above all tables")
    parts: dict[str, Any] = {"vehicle": vehicle_of(tables, path, variant)}
    for name, kind in (("terms", Terms), ("actuator", Actuator)):
        if not isinstance(table := tables.get(name, {}), dict):
            raise ValueError(f"{path}: {name} must be a table [{name}], got {checks.short_repr(table)}")
        if name in tables:
            parts[name] = from_table(kind, table, f"{path}: [{name}]")
    parts["learn"] = tables.get("learn", LEARN)
    return from_table(VehicleModel, parts, str(path))
