"""Record random flights of a true system as a dataset: python -m experiments.make_flights --help"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from rich.console import Console

from experiments.flying.images import picture
from experiments.reporting.tables import Table, print_table
from experiments.runner import command
from experiments.runner.options import CountFromZero, Named
from experiments.runner.progress import Line
from hybrid_jax.io.datasets import Dataset, load_dataset, save_dataset
from hybrid_jax.io.files import digest
from hybrid_jax.rotation import tilt
from hybrid_jax.sim.domain import DOMAINS, Domain
from hybrid_jax.sim.flight import SplitSpec, configuration, make_dataset
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, VELOCITY

LOW = (0.5, 0.2)  # m, mean altitudes over a window below which ground effect adds at least 0.4 % and 2.6 % of thrust
PERCENTILES = (1, 50, 99)


@dataclass(frozen=True)
class Options:
    """Fly a simulated quadrotor along random paths and save windows of the flights as one dataset file.

    The pilot flies between waypoints at up to about 5 m/s, a quarter of the time less than 0.5 m above ground, and
    excites roll and pitch so that the inertia is identifiable. Every split has its own flights. The same arguments give
    the same file, byte for byte; an existing file with other content is never overwritten.

    Example: python -m experiments.make_flights --domain source -o source.npz --train 10000 --validation 1000
    """

    domain: Literal["source", "parameter_shift", "external_force"]
    """Which system. source: drag and ground effect. parameter_shift: the same with Ix 0.040, Iy 0.020 kg m².
    external_force: the same with side wind."""
    output: Annotated[Path, Named(aliases=["-o"])]
    """File to write (.npz)."""
    seed: CountFromZero = 0
    """Random seed."""
    train: CountFromZero = 1000
    """Windows of 0.1 s (10 steps) for training; 0 omits a split."""
    validation: CountFromZero = 1000
    """Windows of 0.1 s."""
    test: Annotated[CountFromZero, Named(name="n-test")] = 0
    """Windows of 1 s (100 steps)."""
    test_with_past: Annotated[CountFromZero, Named(name="n-test-with-past")] = 0
    """Windows of 0.2 s: 10 steps of past and the 10 to predict."""
    picture: Path | None = None
    """Also render the vehicle to this PNG (needs the system package libosmesa6 or libegl1)."""

    def splits(self) -> dict[str, SplitSpec]:
        steps = {"train": 10, "validation": 10, "test": 100, "test_with_past": 20}
        splits = {name: SplitSpec(getattr(self, name), n) for name, n in steps.items() if getattr(self, name) != 0}
        if not splits:
            raise ValueError("no windows requested; give --train, --validation, --n-test or --n-test-with-past")
        return splits


def flights(domain: Domain, splits: Mapping[str, SplitSpec], seed: int, cache_dir: Path) -> Dataset:
    """Return a domain's dataset from the cache folder, or fly and save it; as `read_or_fly`."""
    key = digest(configuration(domain, splits, seed), {})[:12]
    return read_or_fly(cache_dir / f"flights-{domain.name}-{key}.npz", domain, splits, seed)


def read_or_fly(path: Path, domain: Domain, splits: Mapping[str, SplitSpec], seed: int) -> Dataset:
    """Return the dataset in a file, or fly and save it if the file does not exist."""
    if not path.exists():
        with Line(f"flights {domain.name}", Console(stderr=True), "compiling the simulator") as line:
            dataset = make_dataset(domain, splits, seed, lambda share: line.show_share("flying", share))
        save_dataset(path, dataset)
    return load_dataset(path, configuration(domain, splits, seed))


def chosen_flights(path: Path, domain: Domain, splits: Mapping[str, SplitSpec]) -> Dataset:
    whole = load_dataset(path, domain.describe())
    for name, spec in splits.items():
        if name not in whole.splits:
            raise ValueError(f"{path}: has no split {name!r}, only {', '.join(whole.splits)}")
        found, steps = len(whole.splits[name]), whole.splits[name].horizon
        if found < spec.windows:
            raise ValueError(f"{path}: {spec.windows} windows of split {name!r} requested, but it has {found}")
        if steps != spec.steps:
            raise ValueError(f"{path}: split {name!r} has windows of {steps} steps, expected {spec.steps}")
    parts = {name: whole.splits[name][: spec.windows] for name, spec in splits.items()}
    return Dataset(parts, whole.metadata)


def survey(windows: Trajectories) -> dict[str, float]:
    """Return percentiles over all states and fractions of speeds, tilts, altitudes …, by name and unit."""
    x = np.asarray(windows.x)
    altitude, q, rates = x[..., POSITION][..., 2], x[..., QUATERNION], np.abs(x[..., BODY_RATES])
    height = altitude.mean(axis=1)
    channels = {
        "speed [m/s]": np.linalg.norm(x[..., VELOCITY], axis=-1),
        "tilt [deg]": np.degrees(tilt(q)),
        "altitude [m]": altitude,
        "distance from home [m]": np.linalg.norm(x[..., POSITION][..., :2], axis=-1),
        **{f"|{axis} rate| [rad/s]": rates[..., i] for i, axis in enumerate(("roll", "pitch", "yaw"))},
        "rotor speed [rad/s]": np.asarray(windows.u),
    }
    return {f"windows below {limit} m": float((height < limit).mean()) for limit in LOW} | {
        f"{name} p{percentile}": float(np.percentile(values, percentile))
        for name, values in channels.items()
        for percentile in PERCENTILES
    }


def make_flights(options: Options) -> None:
    """Fly and save the dataset unless it exists; print statistics of its splits."""
    dataset = read_or_fly(options.output, DOMAINS[options.domain], options.splits(), options.seed)
    if options.picture is not None:
        picture(options.picture)
    splits = dataset.splits.items()
    lines = [("windows x steps", *(f"{len(split)} x {split.horizon}" for _, split in splits))]
    for kind, form in (("tallies", ""), ("statistics", ".3g")):
        found = [survey(each) if kind == "statistics" else dataset.metadata[kind][name] for name, each in splits]
        lines += [(name.replace("_", " "), *(f"{each[name]:{form}}" for each in found)) for name in found[0]]
    title = f"{dataset.config['domain']}, seed {dataset.config['seed']}"
    print_table(Console(), Table(title, ("", *dataset.splits), lines))


main = partial(command.call, "make_flights", Options, make_flights)

if __name__ == "__main__":
    main()
