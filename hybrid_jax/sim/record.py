"""Datasets of random flights: windows in splits of disjoint flights, with statistics and configuration."""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from hybrid_jax import checks
from hybrid_jax.io.datasets import Dataset, versions
from hybrid_jax.sim.domain import Domain
from hybrid_jax.sim.flight import DT, Flights, fly, gone_wrong
from hybrid_jax.sim.quadrotor import CHUNK
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from hybrid_jax.trajectories import Trajectories, concatenate, windows_of
from hybrid_jax.vehicle import IRIS, Vehicle

RECIPE = 1  # increment when the same configuration no longer gives the same flights
SECONDS = 11.0  # length of a flight
LOW = (0.5, 0.2)  # m, mean altitudes over a window below which ground effect adds at least 0.4 % and 2.6 % of thrust
PERCENTILES = (1, 50, 99)
SPARE = 2  # fly this many times the requested windows, so that few of those kept are neighbours


@dataclass(frozen=True)
class SplitSpec:
    """The number of windows of a split, and of intervals of 0.01 s in each."""

    windows: int
    steps: int

    def __post_init__(self):
        checks.count("windows", self.windows)
        checks.count("steps", self.steps)
        if self.steps > round(SECONDS / DT):
            raise ValueError(f"steps must be at most {round(SECONDS / DT)}, a whole flight, got {self.steps}")


@dataclass
class Tally:
    """Numbers of flights and windows made for a split, and of those rejected."""

    flights: int = 0
    dropped_flights: int = 0
    windows: int = 0
    rejected_windows: int = 0


def make_dataset(
    domain: Domain, splits: Mapping[str, SplitSpec], seed: int, progress: Callable[[float], None] = lambda share: None
) -> Dataset:
    """Simulate flights until every split has its windows (float32). Splits share no flights.

    A split depends on the domain's name, its own name and size and the seed, not on the other splits.

    Args:
        progress: called with the finished share of the work, 0 … 1.

    Raises:
        ValueError: seed is negative, or no flight of this domain stays in bounds.
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
        "tallies": {name: asdict(tally) for name, tally in tallies.items()},
        "statistics": {name: survey(split) for name, split in windows.items()},
    }
    return Dataset(windows, metadata)


def _record_split(domain: Domain, spec: SplitSpec, key: PRNGKeyArray) -> tuple[Trajectories, Tally]:
    """Shuffled, non-overlapping windows of as many flights as needed."""
    key_flights, key_order = jax.random.split(key)
    tally, parts = Tally(), []
    while tally.windows < SPARE * spec.windows:
        flights = fly(domain, CHUNK, SECONDS, jax.random.fold_in(key_flights, tally.flights))
        parts += cut(flights, spec.steps, tally, domain.nominal)
        if not parts:
            raise ValueError(f"domain {domain.name}: none of {tally.flights} flights stayed in bounds")
    windows = concatenate(parts)
    order = np.asarray(jax.random.permutation(key_order, len(windows)))[: spec.windows]
    return windows[order], tally


def cut(flights: Flights, steps: int, tally: Tally, vehicle: Vehicle = IRIS) -> list[Trajectories]:
    """The valid windows of the valid flights (float32). Counts flights and windows in the tally."""
    parts = []
    wrong = gone_wrong(flights.states, vehicle)
    for states, inputs, lowest in zip(*(leaf[~wrong] for leaf in flights[:3]), strict=True):
        windows = windows_of(states.astype(np.float32), inputs.astype(np.float32), DT, steps=steps)
        # With a rotor below ground, the model of ground effect does not apply.
        reach = steps * np.arange(len(windows))[:, None] + np.arange(steps + 1)
        sound = (lowest[reach] >= 0).all(axis=1)
        parts.append(windows[sound])
        tally.windows += int(sound.sum())
        tally.rejected_windows += int((~sound).sum())
    tally.flights += len(wrong)
    tally.dropped_flights += int(wrong.sum())
    return parts


def survey(windows: Trajectories) -> dict[str, float]:
    """Speeds, tilts, altitudes …: percentiles over all states and shares in [0, 1], by name and unit."""
    x = np.asarray(windows.x)
    altitude, q = x[..., POSITION][..., 2], x[..., QUATERNION]
    height = altitude.mean(axis=1)
    rates = np.abs(x[..., BODY_RATES])
    channels = {
        "speed [m/s]": np.linalg.norm(x[..., VELOCITY], axis=-1),
        "tilt [deg]": np.degrees(np.arccos(np.clip(1 - 2 * (q[..., 1] ** 2 + q[..., 2] ** 2), -1, 1))),
        "altitude [m]": altitude,
        "distance from home [m]": np.linalg.norm(x[..., POSITION][..., :2], axis=-1),
        "|roll rate| [rad/s]": rates[..., 0],
        "|pitch rate| [rad/s]": rates[..., 1],
        "|yaw rate| [rad/s]": rates[..., 2],
        "rotor speed [rad/s]": np.asarray(windows.u),
    }
    return {f"windows below {limit} m": float((height < limit).mean()) for limit in LOW} | {
        f"{name} p{percentile}": float(np.percentile(values, percentile))
        for name, values in channels.items()
        for percentile in PERCENTILES
    }


def configuration(domain: Domain, splits: Mapping[str, SplitSpec], seed: int) -> dict[str, Any]:
    """Everything that determines the windows, as JSON values."""
    return domain.describe() | {
        "recipe": RECIPE,
        "splits": {name: asdict(spec) for name, spec in splits.items()},
        "dt": DT,
        "flight_seconds": SECONDS,
        "seed": seed,
    }
