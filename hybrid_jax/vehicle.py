"""What is known of a multirotor before any flight: mass, geometry, nominal coefficients."""

import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from hybrid_jax import checks


@dataclass(frozen=True)
class Vehicle:
    """The constants of a quadrotor, SI units, body frame x forward, y left, z up.

    Attributes:
        mass: [kg].
        inertia: principal moments (Ix, Iy, Iz) [kg m²].
        thrust_coefficient: k, thrust of a rotor is k u² [N/(rad/s)²].
        torque_coefficient: c_m, reaction torque of a rotor is c_m u² [N m/(rad/s)²].
        rotor_positions: (x, y) of each rotor [m].
        spin: sign of each rotor's reaction torque about body z, ±1.
        rotor_radius: [m].
        max_rotor_speed: [rad/s].
        gravity: [m/s²].

    Raises:
        ValueError: a constant that is not finite or not positive, in single precision too, or a list of another length.
    """

    mass: float
    inertia: tuple[float, float, float]
    thrust_coefficient: float
    torque_coefficient: float
    rotor_positions: tuple[tuple[float, float], ...]
    spin: tuple[float, ...]
    max_rotor_speed: float
    rotor_radius: float = 0.0
    gravity: float = 9.81
    name: str = "vehicle"

    def __post_init__(self):
        for name in ("mass", "thrust_coefficient", "torque_coefficient", "max_rotor_speed", "gravity"):
            _require_positive(name, getattr(self, name))
        if self.rotor_radius != 0 or isinstance(self.rotor_radius, bool):
            _require_positive("rotor_radius", self.rotor_radius, "a finite number of at least 0")
        if not isinstance(self.inertia, tuple) or len(self.inertia) != 3:
            raise ValueError(
                f"inertia must be a tuple of three moments (Ix, Iy, Iz), got {checks.short_repr(self.inertia)}"
            )
        for name, moment in zip(("Ix", "Iy", "Iz"), self.inertia, strict=True):
            _require_positive(f"inertia {name}", moment)
        if not _is_four(self.rotor_positions, _is_point):
            got = checks.short_repr(self.rotor_positions)
            raise ValueError(f"rotor_positions must be a tuple of four pairs (x, y) [m], got {got}")
        if not _is_four(self.spin, lambda sign: _is_finite(sign) and abs(sign) == 1):
            raise ValueError(f"spin must be a tuple of four signs +1 or -1, got {checks.short_repr(self.spin)}")
        if not isinstance(self.name, str):
            raise ValueError(f"name must be text, got {checks.short_repr(self.name)}")

    @property
    def hover_speed(self) -> float:
        """The rotor speed [rad/s] at which four equal rotors carry the weight."""
        return math.sqrt(self.mass * self.gravity / (4 * self.thrust_coefficient))


def load_vehicle(path: str | Path, variant: str | None = None) -> Vehicle:
    """Read the table `[vehicle]` of a TOML file whose keys are the attributes of `Vehicle`.

    Args:
        variant: the vehicle as changed by a table `[vehicle.VARIANT]`, which gives some of its constants anew, such as
            the mass with a payload. Variants that are not asked for are checked as well.

    Raises:
        ValueError: the file, the key and what was expected, in one line.
    """
    return vehicle_of(read_tables(path), path, variant)


def read_tables(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        ValueError: the file and why it is not readable, in one line.
    """
    try:
        return tomllib.loads(Path(path).read_bytes().decode())
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a readable TOML file: {checks.first_line(error)}") from error


def vehicle_of(tables: dict[str, Any], path: str | Path, variant: str | None = None) -> Vehicle:
    """The vehicle that the tables of a file describe.

    Raises:
        ValueError: as `load_vehicle`.
    """
    table = tables.get("vehicle")
    if not isinstance(table, dict):
        raise ValueError(f"{path}: has no table [vehicle]")
    known = {field.name for field in fields(Vehicle)}
    changes = {key: table[key] for key in table.keys() - known if isinstance(table[key], dict)}
    if variant is not None and variant not in changes:
        found = ", ".join(sorted(map(repr, changes))) or "none"
        raise ValueError(f"{path}: has no table [vehicle.{variant}]; its variants are {found}")
    common = {key: value for key, value in table.items() if key not in changes}
    vehicle = _made(common, known, f"{path}: [vehicle]")
    variants = {name: _made(common | changes[name], known, f"{path}: [vehicle.{name}]") for name in sorted(changes)}
    return vehicle if variant is None else variants[variant]


def _made(table: dict[str, Any], known: set[str], where: str) -> Vehicle:
    unknown = sorted(repr(key) for key in table.keys() - known)
    if unknown:
        raise ValueError(f"{where}: {', '.join(unknown)}: no constant of a vehicle")
    try:
        return Vehicle(**{key: as_tuple(value) for key, value in table.items()})
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {checks.first_line(error).replace('Vehicle.__init__()', 'table')}") from error


def _require_positive(name: str, value: Any, what: str = "a positive finite number") -> None:
    if not isinstance(value, int | float):  # a vehicle is hashed and written to files: its numbers are Python's own
        raise ValueError(f"{name} must be {what}, got {checks.short_repr(value)}")
    checks.positive(name, value, what)


def _is_finite(value: Any) -> bool:
    number = checks.real(value) if isinstance(value, int | float) else None
    return number is not None and abs(number) <= checks.LARGEST


def _is_point(value: Any) -> bool:
    return isinstance(value, tuple) and len(value) == 2 and all(_is_finite(number) for number in value)


def _is_four(values: Any, is_right: Callable[[Any], bool]) -> bool:
    return isinstance(values, tuple) and len(values) == 4 and all(is_right(value) for value in values)


def as_tuple(value: Any) -> Any:
    """A list of TOML, and lists in it, as tuples, which can be hashed."""
    return tuple(as_tuple(item) for item in value) if isinstance(value, list) else value


# Pegasus Simulator's 3DR Iris, as the paper uses it.
IRIS = Vehicle(
    name="iris",
    mass=1.5,
    inertia=(0.02912, 0.02912, 0.05522),
    thrust_coefficient=8.54858e-6,
    torque_coefficient=1e-6,
    rotor_positions=((0.13799, -0.20672), (-0.12511, 0.21875), (0.13800, 0.20258), (-0.12415, -0.22235)),
    spin=(-1.0, -1.0, 1.0, 1.0),
    rotor_radius=0.128,
    max_rotor_speed=1100.0,
)
