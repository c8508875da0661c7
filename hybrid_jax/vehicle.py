"""A multirotor: its state x (13) and input u, its constants, and their TOML file.

x = [p, q, v, ω]: position p [m, world frame, z up]; unit quaternion q = (w, x, y, z), body → world; velocity
v [m/s, world frame]; body rates ω [rad/s, body frame: x forward, y left, z up]. u: the rotor speeds [rad/s].
"""

import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks

T = TypeVar("T")
State = Float[Array, "13"]
Input = Float[Array, " rotors"]  # rad/s

POSITION, QUATERNION, VELOCITY, BODY_RATES = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)
STATE_NAMES = ("px", "py", "pz", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz")
INPUT_NAMES = ("u0", "u1", "u2", "u3")  # of a quadrotor; see `input_names`
STATE_SIZE, INPUT_SIZE = len(STATE_NAMES), len(INPUT_NAMES)
# Typical standard deviations of each entry of these four: motion capture [m, of quaternions, m/s], a gyroscope [rad/s].
SENSOR_NOISE = (0.001, 0.002, 0.02, 0.02)

FEWEST_ROTORS, MOST_ROTORS = 3, 12
TABLES = ("vehicle", "learn", "terms", "actuator")  # of a vehicle file: see `dynamics.vehicle_file`
# Of vehicles that fly, the radius of gyration √(I / m) is 0.2 to 1 times the longest arm.
LONGEST_ARM = 10.0  # m
LEAST_GYRATION, MOST_GYRATION = 0.01, 10.0  # times the longest arm
ROUNDING = 0.05  # share by which a moment may exceed the sum of the other two: a flat body, rounded to two digits


@dataclass(frozen=True)
class Vehicle:
    """The constants of a multirotor. In its body frame x points forward, y left and z up.

    Attributes:
        mass: mass [kg]. It should include the battery and a payload.
        inertia: principal moments (Ix, Iy, Iz) about the centre of mass [kg m²].
        thrust_coefficient: k [N/(rad/s)²]; the thrust of a rotor is k u².
        torque_coefficient: c_m [N m/(rad/s)²]; the reaction torque of a rotor is c_m u².
        rotor_positions: (x, y) of each rotor from the centre of mass [m].
        spin: the sign of each rotor's reaction torque about body z, ±1.
        max_rotor_speed: the largest rotor speed [rad/s].
        rotor_radius: radius of a rotor [m]; 0 if unknown.
        gravity: acceleration of free fall [m/s²].
        name: what reports and messages call the vehicle.

    Raises:
        ValueError: if a number is not positive and finite, physically impossible, or in the wrong unit.
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
        require_numbers("inertia", self.inertia, (3,), "a tuple of three moments (Ix, Iy, Iz)")
        n = len(self.rotor_positions) if isinstance(self.rotor_positions, tuple) else 0
        pairs = f"a tuple of {FEWEST_ROTORS} to {MOST_ROTORS} pairs (x, y) [m], one for each rotor"
        rotors = n if FEWEST_ROTORS <= n <= MOST_ROTORS else FEWEST_ROTORS
        require_numbers("rotor_positions", self.rotor_positions, (rotors, 2), pairs)
        signs = f"a tuple of {n} signs +1 or -1, one for each of rotor_positions"
        require_numbers("spin", self.spin, (n,), signs)
        if any(abs(sign) != 1 for sign in self.spin):
            raise ValueError(f"spin must be {signs}, got {checks.short_repr(self.spin)}")
        positive = ("mass", "thrust_coefficient", "torque_coefficient", "max_rotor_speed", "gravity")
        numbers = {name: getattr(self, name) for name in (*positive, "rotor_radius")}
        moments = zip(("Ix", "Iy", "Iz"), self.inertia, strict=True)
        for name, value in (numbers | {f"inertia {axis}": moment for axis, moment in moments}).items():
            require_numbers(name, value, (), "a finite number")
            (checks.not_negative if name == "rotor_radius" else checks.positive)(name, value)
        if not isinstance(self.name, str):
            raise ValueError(f"name must be text, got {checks.short_repr(self.name)}")
        self._require_possible()

    def _require_possible(self) -> None:
        """Reject physically impossible values, and lengths and moments in another unit."""
        arm = max(math.hypot(*place) for place in self.rotor_positions)
        if len(set(self.rotor_positions)) < 2:
            raise ValueError(f"rotor_positions must not all be equal, got {self.rotor_positions[0]} for each rotor")
        if arm > LONGEST_ARM:
            raise ValueError(f"rotor_positions must be in m: a rotor is {arm:.4g} m from the centre; 1 mm is 0.001")
        largest = max(self.inertia)
        if largest > (1 + ROUNDING) * (sum(self.inertia) - largest):
            rule = "a body's largest moment is at most the sum of the other two"
            raise ValueError(f"inertia must be (Ix, Iy, Iz) in kg m² of one body, got {self.inertia}: {rule}")
        low, high = (self.mass * (factor * arm) ** 2 for factor in (LEAST_GYRATION, MOST_GYRATION))
        if not low <= largest <= high:
            units = "mass in kg, rotor_positions in m, inertia in kg m² (1 g cm² is 1e-7)"
            fits = f"{self.mass:.4g} kg with rotors {arm:.4g} m from the centre has {low:.2g} to {high:.2g} kg m²"
            raise ValueError(f"inertia must match mass and rotor_positions, got {largest:.4g}: {fits}; give {units}")

    @property
    def rotors(self) -> int:
        """The number of rotors."""
        return len(self.rotor_positions)

    @property
    def hover_speed(self) -> float:
        """The rotor speed [rad/s] at which equal rotors carry the weight."""
        return math.sqrt(self.mass * self.gravity / (self.rotors * self.thrust_coefficient))

    @property
    def mixer(self) -> Float[np.ndarray, "4 rotors"]:
        """Thrust [N] and torque [N m, body] of the rotors per square of their speeds [(rad/s)²]."""
        (x, y), k = np.array(self.rotor_positions).T, self.thrust_coefficient
        return np.stack([np.full(self.rotors, k), k * y, -k * x, self.torque_coefficient * np.array(self.spin)])


def input_names(rotors: int) -> tuple[str, ...]:
    return tuple(f"u{i}" for i in range(rotors))


def load_vehicle(path: str | Path, variant: str | None = None) -> Vehicle:
    """Read the table `[vehicle]` of a TOML file. Its keys should be the attributes of `Vehicle`.

    To read and check the other tables, you should use `dynamics.vehicle_file.load_vehicle_model` instead.

    Args:
        path: the TOML file.
        variant: name of a table `[vehicle.VARIANT]` that overrides constants, for example the mass with a payload. All
            variants of the file are checked.

    Raises:
        ValueError: if a key is invalid, with the file, the key and what was expected.
    """
    tables = read_tables(path)
    vehicle = vehicle_of(tables, path, variant)
    require_known(str(path), tables, TABLES)
    return vehicle


def read_tables(path: str | Path) -> dict[str, Any]:
    """Read a TOML file, with or without a byte order mark; ValueError if it is not readable."""
    try:
        return tomllib.loads(checks.content_of(path).decode("utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a readable TOML file: {checks.first_line(error)}") from error


def vehicle_of(tables: Mapping[str, Any], path: str | Path, variant: str | None = None) -> Vehicle:
    """Make the vehicle of a file from its tables; see `load_vehicle`."""
    table = tables.get("vehicle")
    if not isinstance(table, dict):
        raise ValueError(f"{path}: has no table [vehicle]")
    own = Vehicle.__dataclass_fields__
    changes = {key: value for key, value in table.items() if key not in own and isinstance(value, dict)}
    if variant is not None and variant not in changes:
        found = ", ".join(sorted(map(repr, changes))) or "none"
        raise ValueError(f"{path}: has no table [vehicle.{variant}]; its variants are {found}")
    common = {key: value for key, value in table.items() if key not in changes}
    vehicles: dict[str | None, Vehicle] = {None: from_table(Vehicle, common, f"{path}: [vehicle]")}
    for name in sorted(changes):
        vehicles[name] = from_table(Vehicle, common | changes[name], f"{path}: [vehicle.{name}]")
    return vehicles[variant]


def from_table(cls: type[T], table: Mapping[str, Any], where: str) -> T:
    """Make a dataclass from a TOML table; ValueError, after `where`, for a wrong or missing key or an invalid value."""
    required = [each.name for each in fields(cls) if each.default is MISSING and each.default_factory is MISSING]  # type: ignore
    require_known(where, table, [each.name for each in fields(cls)])  # type: ignore
    if missing := [name for name in required if name not in table]:
        raise ValueError(f"{where}: {', '.join(missing)}: must be given")
    try:
        return cls(**{key: as_tuple(value) for key, value in table.items()})
    except ValueError as error:
        raise ValueError(f"{where}: {checks.first_line(error)}") from error


def require_known(where: str, table: Mapping[str, Any], known: Iterable[str]) -> None:
    if unknown := sorted(repr(key) for key in table.keys() - set(known)):
        raise ValueError(f"{where}: {', '.join(unknown)}: must be one of {', '.join(known)}")


def require_numbers(name: str, value: Any, shape: tuple[int, ...], what: str) -> None:
    """Raise ValueError unless the value is a finite number, or nested tuples of finite numbers, of this shape."""

    def fits(value: Any, shape: tuple[int, ...]) -> bool:
        if shape:
            return isinstance(value, tuple) and len(value) == shape[0] and all(fits(part, shape[1:]) for part in value)
        # Not NumPy's scalars, because a vehicle is hashed and written to files.
        number = checks.real(value) if isinstance(value, int | float) else None
        return number is not None and abs(number) <= checks.LARGEST

    if not fits(value, shape):
        raise ValueError(f"{name} must be {what}, got {checks.short_repr(value)}")


def as_tuple(value: Any) -> Any:
    """Convert nested lists of TOML to tuples, which are hashable."""
    return tuple(as_tuple(item) for item in value) if isinstance(value, list) else value


# The 3DR Iris of Pegasus Simulator, as in the paper.
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
