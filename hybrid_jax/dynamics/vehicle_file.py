"""A vehicle file read whole: what flies, what else is known of it, and what may be learned.

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
    """What a vehicle file says.

    Attributes:
        vehicle: the known constants and nominal values.
        terms: nominal values of what a rigid body leaves out.
        learn: names of `multirotor.SHAPES`, and "motor_time_constant" where the rotors' lag is to be found.

    Raises:
        ValueError: a name of nothing that can be learned.
    """

    vehicle: Vehicle
    terms: Terms = field(default_factory=Terms)
    learn: tuple[str, ...] = LEARNED

    def __post_init__(self):
        check_learned(self.learn)

    @property
    def learns_motor_lag(self) -> bool:
        """Whether the rotors' time constant is to be found from the logs."""
        return LAG in self.learn

    def physics(self) -> Multirotor:
        """The field at its nominal values."""
        return multirotor(self.vehicle, of_field(self.learn), self.terms)


def check_learned(learn: tuple[str, ...]) -> None:
    """Refuse names of nothing that a field or, of the rotors' lag, the logs can teach.

    Raises:
        ValueError: what is there to be named, or which names do not go together.
    """
    if not isinstance(learn, tuple) or not all(isinstance(name, str) for name in learn):
        raise ValueError(f"learn must be a list of names, got {checks.short_repr(learn)}")
    if learn.count(LAG) > 1 or not set(learn) <= {*SHAPES, LAG}:
        raise ValueError(f"learn must be names of {', '.join([*SHAPES, LAG])}, each once, got {', '.join(learn)}")
    check_names(of_field(learn))


def of_field(learn: tuple[str, ...]) -> tuple[str, ...]:
    """Those names that a field learns: all but the rotors' lag."""
    return tuple(name for name in learn if name != LAG)


def load_description(path: str | Path, variant: str | None = None) -> VehicleDescription:
    """Read a TOML file of `[vehicle]`, `learn` and `[terms]`; without the last two it is a rigid body that learns
    Ix, Iy and k.

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
