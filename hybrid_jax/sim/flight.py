"""Random closed-loop flights of a domain, and datasets of windows in splits of disjoint flights."""

import math
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt

from hybrid_jax import checks
from hybrid_jax.dynamics.batching import like
from hybrid_jax.io.datasets import Dataset, versions
from hybrid_jax.runtime import COMPILE_FLIGHTS, entry, jit_with
from hybrid_jax.sim import pilot
from hybrid_jax.sim.domain import CHUNK, Domain, Quadrotor
from hybrid_jax.sim.forces import Parameters, parameters_of, rotor_altitudes
from hybrid_jax.trajectories import Trajectories, concatenate, windows_of
from hybrid_jax.vehicle import IRIS, POSITION, VELOCITY, Vehicle

DT = pilot.PERIOD  # s
AXIS = "flights"
CLOCK = 60.0  # s: flights start at a random time in [0, CLOCK), at any phase of the wind

# Bounds of a valid flight of the Iris; they are scaled for other vehicles.
MAX_DISTANCE, MAX_ALTITUDE, MAX_SPEED = 20.0, 10.0, 15.0  # m from home in the plane, m, m/s
RECIPE = 1  # increment it when the same configuration no longer gives the same flights
SECONDS = 11.0  # length of a flight
SPARE = 2  # flown over requested windows, so that few windows are neighbours


class Flights(NamedTuple):
    """n simulated flights of t intervals, in float64.

    Attributes:
        states: states (n, t + 1, 13), as in `hybrid_jax.vehicle`.
        inputs: rotor speeds (n, t, rotors) [rad/s], held from one state to the next.
        lowest_rotor: altitude of the lowest rotor (n, t + 1) [m].
        start: time of the first state (n,) [s].
    """

    states: Float[Array | np.ndarray, "*n t+1 13"]
    inputs: Float[Array | np.ndarray, "*n t rotors"]
    lowest_rotor: Float[Array | np.ndarray, "*n t+1"]
    start: Float[Array | np.ndarray, "*n"]


def random_flights(domain: Domain, flights: int, seconds: float, key: PRNGKeyArray) -> Flights:
    """Simulate random closed-loop flights of `seconds` each, at 100 Hz, always in float64 and on the CPU.

    Flight i depends only on the key and i.

    Args:
        domain: the simulated system.
        flights: number of flights.
        seconds: length of each flight [s].

    Raises:
        ValueError: if flights or seconds are not positive, or key is not a random key.
    """
    checks.count("flights", flights)
    checks.positive("seconds", seconds)
    checks.key("key", key)
    steps = round(seconds / DT)
    checks.count(f"intervals of {DT} s in seconds={seconds}", steps)
    cpus = jax.local_devices(backend="cpu")
    mesh = Mesh(np.array(cpus[: math.gcd(CHUNK, len(cpus))]), (AXIS,))
    numbers = np.arange(-(-flights // CHUNK) * CHUNK, dtype=np.uint32).reshape(-1, CHUNK)
    with jax.enable_x64(True), jax.default_device(cpus[0]):
        vehicles = domain.quadrotor(), parameters_of(domain.nominal)
        shared = jax.device_put((*vehicles, key), NamedSharding(mesh, PartitionSpec()))
        # Chunks of equal size share one compilation.
        chunks = [jax.device_put(chunk, NamedSharding(mesh, PartitionSpec(AXIS))) for chunk in numbers]
        parts = [_fly_chunk(shared, chunk, steps, domain.nominal, mesh) for chunk in chunks]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:flights], *jax.device_get(parts))


@jit_with(COMPILE_FLIGHTS)
def _fly_chunk(
    shared: tuple[Quadrotor, Parameters, PRNGKeyArray],
    numbers: UInt[Array, " n"],
    steps: int,
    vehicle: Vehicle,
    mesh: Mesh,
) -> Flights:
    """Simulate the flights with these numbers, an even share of them on each device of the mesh."""
    truth, nominal, key = shared
    scale = pilot.scale_of(vehicle)

    def one_flight(number: UInt[Array, ""]) -> Flights:
        key_course, key_start, key_clock = jax.random.split(jax.random.fold_in(key, number), 3)
        course = pilot.draw_course(steps, scale, key_course)
        x0 = pilot.starting_state(course, scale, key_start)
        start = jax.random.uniform(key_clock, maxval=CLOCK)

        def decide(carry, now):
            integral, x, t = carry
            integral, u = pilot.act(integral, x, now, nominal, vehicle, scale)
            x = truth.step(x, u, t, DT)
            return (integral, x, t + DT), (x, u)

        _, (x, u) = jax.lax.scan(decide, (like(jnp.zeros(3), x0), x0, start), course)
        states = jnp.concatenate([x0[None], x])
        altitudes = jax.vmap(rotor_altitudes, in_axes=(0, None))(states, truth.parameters.rotor_positions)
        return Flights(states, u, altitudes.min(axis=1), start)

    split = PartitionSpec(AXIS)
    return jax.shard_map(jax.vmap(one_flight), mesh=mesh, in_specs=split, out_specs=split, check_vma=False)(numbers)


def gone_wrong(states: Float[Array | np.ndarray, "n t 13"], vehicle: Vehicle = IRIS) -> np.ndarray:
    """Return which flights (n,) of a vehicle diverged, left the arena, were too fast or crashed.

    Args:
        states: states (n, t, 13) of n flights.
        vehicle: the vehicle, whose size sets the limits.
    """
    scale, altitude = pilot.scale_of(vehicle), states[..., POSITION][..., 2]
    far = np.linalg.norm(states[..., POSITION][..., :2], axis=-1) > MAX_DISTANCE * scale.length
    fast = np.linalg.norm(states[..., VELOCITY], axis=-1) > MAX_SPEED * scale.speed
    outside = (altitude > MAX_ALTITUDE * scale.length) | (altitude < 0)
    return (far | fast | outside | ~np.isfinite(states).all(axis=-1)).any(axis=1)


@dataclass(frozen=True)
class SplitSpec:
    """The number of windows of a split, and their length.

    Attributes:
        windows: number of windows.
        steps: number of intervals of 0.01 s in each window.
        flights: take the first windows of this many flights, in order, instead of random windows of many flights.
    """

    windows: int
    steps: int
    flights: int = 0

    def __post_init__(self):
        checks.count("windows", self.windows)
        checks.count("steps", self.steps)
        checks.count("flights", self.flights, least=0)
        if self.flights and (self.windows % self.flights or self.windows * self.steps > self.flights * SECONDS / DT):
            raise ValueError(f"windows must be a multiple of the {self.flights} flights, got {self.windows}")
        if self.steps > round(SECONDS / DT):
            raise ValueError(f"steps must be at most {round(SECONDS / DT)}, a whole flight, got {self.steps}")


@entry
def make_dataset(
    domain: Domain, splits: Mapping[str, SplitSpec], seed: int, progress: Callable[[float], None] = lambda share: None
) -> Dataset:
    """Simulate flights until every split has its windows (float32). Splits share no flights.

    A split depends on the domain's name, on its own name and size, and on the seed, but not on the other splits.

    Args:
        domain: the simulated system.
        splits: the size of each split, by its name.
        seed: the seed of all random numbers, at least 0.
        progress: a function that is called with the finished fraction of the work, 0 to 1.

    Raises:
        ValueError: if the seed is negative, or no flight of this domain stays in bounds.
    """
    checks.count("seed", seed, least=0)
    windows, tallies = {}, {}
    total, done = sum(spec.windows * spec.steps for spec in splits.values()), 0
    for name, spec in splits.items():
        own_key = jax.random.fold_in(jax.random.key(seed), zlib.crc32(f"{domain.name}/{name}".encode()))
        windows[name], tallies[name] = _record_split(domain, spec, own_key)
        done += spec.windows * spec.steps
        progress(done / total)
    metadata = {
        "config": configuration(domain, splits, seed),
        "versions": versions("jax", "mujoco", "mujoco-mjx", "numpy", "hybrid_jax"),
        "tallies": {name: dict(tally) for name, tally in tallies.items()},
    }
    return Dataset(windows, metadata)


def _record_split(domain: Domain, spec: SplitSpec, key: PRNGKeyArray) -> tuple[Trajectories, Counter[str]]:
    """Return shuffled, non-overlapping windows of as many flights as needed, or the first windows of whole flights."""
    key_flights, key_order = jax.random.split(key)
    tally, parts = Counter[str](), []
    each = spec.windows // spec.flights if spec.flights else 0
    while tally["windows"] < SPARE * spec.windows if not spec.flights else len(parts) < spec.flights:
        flights = random_flights(domain, CHUNK, SECONDS, jax.random.fold_in(key_flights, tally["flights"]))
        found = cut(flights, spec.steps, tally, domain.nominal)
        whole = round(SECONDS / DT) // spec.steps  # windows of a flight if no window is dropped
        parts += [part[:each] for part in found if len(part) == whole] if spec.flights else found
        if not parts:
            raise ValueError(f"domain {domain.name}: all {tally['flights']} flights left the bounds; use weaker forces")
    if spec.flights:
        return concatenate(parts[: spec.flights]), tally
    windows = concatenate(parts)
    return windows[permutation(key_order, len(windows))[: spec.windows]], tally


def permutation(key: PRNGKeyArray, n: int) -> Int[np.ndarray, " n"]:
    """Return `jax.random.permutation(key, n)` without compiling two programs for every n, which takes half a second."""
    order = np.arange(n)
    for _ in range(math.ceil(3 * math.log(max(n, 1)) / math.log(2**32 - 1))):
        # The first numbers are the same however many are drawn (jax_threefry_partitionable).
        key, drawn = _drawn(key, max(2 ** (n - 1).bit_length(), 1024))
        order = order[np.argsort(np.asarray(drawn)[:n], kind="stable")]
    return order


@jit_with(COMPILE_FLIGHTS)
def _drawn(key: PRNGKeyArray, n: int) -> tuple[PRNGKeyArray, UInt[Array, " n"]]:
    key, own = jax.random.split(key)
    return key, jax.random.bits(own, (n,), jnp.uint32)


def cut(flights: Flights, steps: int, tally: Counter[str], vehicle: Vehicle = IRIS) -> list[Trajectories]:
    """Return the valid windows of the valid flights (float32); count flights, windows and dropped ones in the tally."""
    parts, wrong = [], gone_wrong(flights.states, vehicle)
    tally.update(flights=len(wrong), dropped_flights=int(wrong.sum()))
    for states, inputs, lowest in zip(*(leaf[~wrong] for leaf in flights[:3]), strict=True):
        windows = windows_of(states.astype(np.float32), inputs.astype(np.float32), DT, steps=steps)
        # With a rotor below ground, the model of ground effect does not apply.
        reach = steps * np.arange(len(windows))[:, None] + np.arange(steps + 1)
        sound = (lowest[reach] >= 0).all(axis=1)
        parts.append(windows[sound])
        tally.update(windows=int(sound.sum()), rejected_windows=int((~sound).sum()))
    return parts


def configuration(domain: Domain, splits: Mapping[str, SplitSpec], seed: int) -> dict[str, Any]:
    return domain.describe() | {
        "recipe": RECIPE,
        "splits": {name: asdict(spec) for name, spec in splits.items()},
        "dt": DT,
        "flight_seconds": SECONDS,
        "seed": seed,
    }
