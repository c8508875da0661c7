"""Random flights cut into the windows that models learn from: splits of disjoint flights, and how they came about."""

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
from hybrid_jax.sim.survey import survey
from hybrid_jax.trajectories import Trajectories, concatenate, windows_of
from hybrid_jax.vehicle import IRIS, Vehicle

RECIPE = 1  # raise it when the same configuration no longer gives the same flights
SECONDS = 11.0  # length of a flight
SPARE = 2  # fly this many times the windows asked for, so that few of those kept are neighbours


@dataclass(frozen=True)
class SplitSpec:
    """How many windows a split has, and of how many intervals of 0.01 s each."""

    windows: int
    steps: int

    def __post_init__(self):
        checks.count("windows", self.windows)
        checks.count("steps", self.steps)
        if self.steps > round(SECONDS / DT):
            raise ValueError(f"steps must be at most {round(SECONDS / DT)}, a whole flight, got {self.steps}")


# The paper's sets. The target's train split is the pool that nested subsets are the first N of; test_with_past holds
# 10 steps of past for Expert Augmentation and the 10 to predict.
SOURCE_SPLITS = {"train": SplitSpec(10_000, 10), "validation": SplitSpec(1000, 10)}
TARGET_SPLITS = {
    "train": SplitSpec(1000, 10),
    "validation": SplitSpec(1000, 10),
    "test": SplitSpec(1000, 100),
    "test_with_past": SplitSpec(1000, 20),
}


@dataclass
class Tally:
    """What was flown for a split, flights that went wrong included, and which of its windows were sound."""

    flights: int = 0
    dropped_flights: int = 0
    windows: int = 0
    rejected_windows: int = 0


Progress = Callable[[float], None]


def record(
    domain: Domain, splits: Mapping[str, SplitSpec], key: PRNGKeyArray, progress: Progress = lambda share: None
) -> tuple[dict[str, Trajectories], dict[str, Tally]]:
    """Fly until every split has its windows, each split from flights of its own: windows (float32) and tally by split.

    A split depends on the domain's name, its own name and size and the key, not on the other splits.

    Args:
        progress: called with the share of the windows that is done, 0 … 1.

    Raises:
        ValueError: flights of this domain all go wrong.
    """
    windows, tallies = {}, {}
    total, done = sum(spec.windows * spec.steps for spec in splits.values()), 0
    for name, spec in splits.items():
        own_key = jax.random.fold_in(key, zlib.crc32(f"{domain.name}/{name}".encode()))
        windows[name], tallies[name] = record_split(domain, spec, own_key)
        done += spec.windows * spec.steps
        progress(done / total)
    return windows, tallies


def record_split(domain: Domain, spec: SplitSpec, key: PRNGKeyArray) -> tuple[Trajectories, Tally]:
    """Shuffled windows that touch but do not overlap, from as many flights as it takes.

    Raises:
        ValueError: flights of this domain all go wrong.
    """
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
    """The sound windows of the sound flights, float32; counts in the tally what was flown and left out."""
    parts = []
    wrong = gone_wrong(flights.states, vehicle)
    for states, inputs, lowest in zip(*(leaf[~wrong] for leaf in flights[:3]), strict=True):
        windows = windows_of(states.astype(np.float32), inputs.astype(np.float32), DT, steps=steps)
        # A tilted rotor below ground is no flight that ground effect describes.
        reach = steps * np.arange(len(windows))[:, None] + np.arange(steps + 1)
        sound = (lowest[reach] >= 0).all(axis=1)
        parts.append(windows[sound])
        tally.windows += int(sound.sum())
        tally.rejected_windows += int((~sound).sum())
    tally.flights += len(wrong)
    tally.dropped_flights += int(wrong.sum())
    return parts


def configuration(domain: Domain, splits: Mapping[str, SplitSpec], seed: int) -> dict[str, Any]:
    """All that fixes the windows, as JSON would hold it."""
    return domain.describe() | {
        "recipe": RECIPE,
        "splits": {name: asdict(spec) for name, spec in splits.items()},
        "dt": DT,
        "flight_seconds": SECONDS,
        "seed": seed,
    }


def make_dataset(
    domain: Domain, splits: Mapping[str, SplitSpec], seed: int, progress: Progress = lambda share: None
) -> Dataset:
    """Record a domain and write down how: configuration, versions, what was left out, statistics of the windows.

    Raises:
        ValueError: a negative seed, or a domain whose flights all go wrong.
    """
    checks.count("seed", seed, least=0)
    windows, tallies = record(domain, splits, jax.random.key(seed), progress)
    metadata = {
        "config": configuration(domain, splits, seed),
        "versions": versions("jax", "mujoco", "mujoco-mjx", "numpy", "hybrid_jax"),
        "tallies": {name: asdict(tally) for name, tally in tallies.items()},
        "statistics": {name: survey(split) for name, split in windows.items()},
    }
    return Dataset(windows, metadata)
