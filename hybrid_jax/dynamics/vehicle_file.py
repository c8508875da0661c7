"""Vehicle files in TOML: constants, nominal values of further terms, and names of learned parameters.

learn = ["Ix", "Iy", "k_rotors", "drag", "aerodynamic_moment"]    # names of `multirotor.SHAPES`; above all tables

[vehicle]            # the constants of `Vehicle`
mass = 0.037
…

[vehicle.payload]    # a variant: some constants anew
mass = 0.0444

[terms]              # nominal values of `Terms`, known or to start from; zero where not given
drag = [0.01, 0.01, 0.0]
"""

from dataclasses import dataclass, field, fields
from pathlib import Path

from hybrid_jax import checks
from hybrid_jax.dynamics.multirotor import Multirotor, multirotor
from hybrid_jax.dynamics.rigid_body import LEARNED
from hybrid_jax.dynamics.terms import SHAPES, Terms, check_names
from hybrid_jax.vehicle import Vehicle, as_tuple, read_tables, vehicle_of

LAG = "motor_time_constant"  # learned on the logs: see `hybrid_jax.flights.rotor_lag`
TABLES = ("vehicle", "learn", "terms")


@dataclass(frozen=True)
class VehicleDescription:
    """The content of a vehicle file.

    Attributes:
        vehicle: the known constants and nominal values.
        terms: nominal values of the terms beyond a rigid body.
        learn: names of `multirotor.SHAPES`, and "motor_time_constant" to estimate the rotors' lag.

    Raises:
        ValueError: an unknown parameter name.
    """

    vehicle: Vehicle
    terms: Terms = field(default_factory=Terms)
    learn: tuple[str, ...] = LEARNED

    def __post_init__(self):
        check_learned(self.learn)

    @property
    def learns_motor_lag(self) -> bool:
        """Whether to estimate the rotors' time constant from the logs."""
        return LAG in self.learn

    def physics(self) -> Multirotor:
        """The field at its nominal values."""
        return multirotor(self.vehicle, of_field(self.learn), self.terms)


def check_learned(learn: tuple[str, ...]) -> None:
    """Raise if `learn` contains an unknown parameter name.

    Raises:
        ValueError: the known names, or which names do not go together.
    """
    if not isinstance(learn, tuple) or not all(isinstance(name, str) for name in learn):
        raise ValueError(f"learn must be a list of names, got {checks.short_repr(learn)}")
    if learn.count(LAG) > 1 or not set(learn) <= {*SHAPES, LAG}:
        raise ValueError(f"learn must be names of {', '.join([*SHAPES, LAG])}, each once, got {', '.join(learn)}")
    check_names(of_field(learn))


def of_field(learn: tuple[str, ...]) -> tuple[str, ...]:
    """The names of the field's parameters: all but the rotors' lag."""
    return tuple(name for name in learn if name != LAG)


def load_description(path: str | Path, variant: str | None = None) -> VehicleDescription:
    """Read a TOML file of `[vehicle]`, `learn` and `[terms]`; by default, a rigid body that
    learns Ix, Iy and k.

    Args:
        variant: as for `load_vehicle`.

    Raises:
        ValueError: the file, the key and what was expected, in one line.
    """
    tables = read_tables(path)
    unknown = sorted(repr(key) for key in tables.keys() - set(TABLES))
    if unknown:
        raise ValueError(f"{path}: {', '.join(unknown)}: must be one of {', '.join(TABLES)}")
    if "learn" in (tables["vehicle"] if isinstance(tables.get("vehicle"), dict) else {}):
        raise ValueError(f"{path}: [vehicle]: learn must stand above all tables")
    vehicle = vehicle_of(tables, path, variant)
    try:
        return VehicleDescription(vehicle, _terms(tables.get("terms", {})), as_tuple(tables.get("learn", [*LEARNED])))
    except ValueError as error:
        raise ValueError(f"{path}: {checks.first_line(error)}") from error


def _terms(table) -> Terms:
    if not isinstance(table, dict):
        raise ValueError(f"terms must be a table [terms], got {checks.short_repr(table)}")
    known = [entry.name for entry in fields(Terms)]
    unknown = sorted(repr(key) for key in table.keys() - set(known))
    if unknown:
        raise ValueError(f"[terms]: {', '.join(unknown)}: must be one of {', '.join(known)}")
    try:
        return Terms(**{key: as_tuple(value) for key, value in table.items()})
    except ValueError as error:
        raise ValueError(f"[terms]: {checks.first_line(error)}") from error
