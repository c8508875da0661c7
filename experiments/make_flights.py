"""Record random flights of a true system as a dataset: python -m experiments.make_flights --help"""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from experiments.reporting.tables import Table, print_tables
from experiments.runner import command
from hybrid_jax.io.datasets import Dataset, config_hash, load_dataset, require_config, save_dataset
from hybrid_jax.sim.domain import DOMAINS, Domain
from hybrid_jax.sim.record import SplitSpec, configuration, make_dataset
from hybrid_jax.sim.render import picture

NOTES = Console(stderr=True)


@dataclass(frozen=True)
class Options:
    """Fly a simulated quadrotor at random and save windows of the flights as one dataset file.

    The pilot wanders between waypoints at up to about 5 m/s, a quarter of the time less than 0.5 m above ground, and
    shakes the vehicle so that its inertia shows. Every split comes from flights of its own. The same arguments give the
    same file, byte for byte; a file that exists with other content is never overwritten.

    Example: python -m experiments.make_flights --domain source --out source.npz --train 10000 --validation 1000
    """

    domain: Literal["source", "parameter_shift", "external_force"]
    """source: drag and ground effect. parameter_shift: the same with Ix 0.040, Iy 0.020 kg m². external_force: the same
    with side wind."""
    out: Path
    """File to write (.npz)."""
    seed: int = 0
    """Everything random follows from it."""
    train: int = 1000
    """Windows of 0.1 s (10 steps) to learn from; 0 leaves a split out."""
    validation: int = 1000
    """Windows of 0.1 s."""
    test: int = 0
    """Windows of 1 s (100 steps)."""
    test_with_past: int = 0
    """Windows of 0.2 s: 10 steps of past and the 10 to predict."""
    picture: Path | None = None
    """Also render the vehicle to this PNG (needs the system package libosmesa6 or libegl1)."""

    def splits(self) -> dict[str, SplitSpec]:
        """The splits asked for.

        Raises:
            ValueError: none, or a negative size.
        """
        steps = {"train": 10, "validation": 10, "test": 100, "test_with_past": 20}
        splits = {name: SplitSpec(getattr(self, name), n) for name, n in steps.items() if getattr(self, name) != 0}
        if not splits:
            raise ValueError("no windows asked for: give --train, --validation, --test or --test-with-past")
        return splits


def flights(domain: Domain, splits: Mapping[str, SplitSpec], seed: int, cache_dir: str | Path) -> Dataset:
    """The dataset of a domain from the cache folder, flown and put there if it is not.

    Raises:
        ValueError: a cached file is damaged; says which, so that it can be deleted.
    """
    digest = config_hash(configuration(domain, splits, seed))
    return read_or_fly(Path(cache_dir) / f"flights-{domain.name}-{digest[:12]}.npz", domain, splits, seed)


def read_or_fly(path: Path, domain: Domain, splits: Mapping[str, SplitSpec], seed: int) -> Dataset:
    """The dataset in a file, flown and written there if the file does not exist.

    Raises:
        ValueError: the file is damaged or holds a dataset of another configuration.
    """
    if not path.exists():
        with progress_bar(f"flying {domain.name}") as advance:
            save_dataset(path, make_dataset(domain, splits, seed, advance))
    return load_dataset(path, configuration(domain, splits, seed))


def chosen_flights(path: Path, domain: Domain, splits: Mapping[str, SplitSpec]) -> Dataset:
    """The windows asked for, the first of each split of a file that was made before.

    Raises:
        ValueError: the file is damaged, of another domain, or has fewer windows or others than asked for.
    """
    whole = load_dataset(path)
    expected = domain.describe()
    require_config(path, {key: whole.config.get(key) for key in expected}, expected)
    parts = {name: whole.first(name, spec.windows) for name, spec in splits.items()}
    for name, spec in splits.items():
        if parts[name].horizon != spec.steps:
            raise ValueError(
                f"{path}: split {name!r} has windows of {parts[name].horizon} steps, expected {spec.steps}"
            )
    return Dataset(parts, whole.metadata, origin=str(path))


class progress_bar(AbstractContextManager):
    """A bar on stderr; entering gives the function to call with the share done, 0 … 1."""

    def __init__(self, title: str):
        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        self._progress = Progress(*columns, console=NOTES, transient=True)
        self._task = self._progress.add_task(title, total=1.0)

    def __enter__(self) -> Callable[[float], None]:
        self._progress.start()
        return lambda share: self._progress.update(self._task, completed=share)

    def __exit__(self, *exception) -> None:
        self._progress.stop()


def statistics_table(dataset: Dataset) -> Table:
    """Counts and statistics of the flights, a column for each split."""
    tallies, statistics = dataset.metadata["tallies"], dataset.metadata["statistics"]
    lines = [("windows x steps", *(f"{len(split)} x {split.horizon}" for split in dataset.splits.values()))]
    lines += [
        (name.replace("_", " "), *(str(tallies[split][name]) for split in dataset.splits))
        for name in next(iter(tallies.values()))
    ]
    lines += [
        (name, *(f"{statistics[split][name]:.3g}" for split in dataset.splits))
        for name in next(iter(statistics.values()))
    ]
    return Table(f"{dataset.config['domain']}, seed {dataset.config['seed']}", ("", *dataset.splits), lines)


def make_flights(options: Options) -> None:
    """Record what is not there yet, print the table."""
    dataset = read_or_fly(options.out, DOMAINS[options.domain], options.splits(), options.seed)
    if options.picture is not None:
        picture(options.picture)
    print_tables(Console(), [statistics_table(dataset)])


def main() -> None:
    """The command line."""
    command.call("make_flights", Options, make_flights)


if __name__ == "__main__":
    main()
