"""Datasets of windows, each in one archive."""

import platform
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_jax.checks import first_line
from hybrid_jax.io.archive import digest, encode, load_archive, save_archive
from hybrid_jax.trajectories import Trajectories, check, check_attitudes

FORMAT = "hybrid_jax dataset 1"
ARRAYS = ("x0", "u", "x")


@dataclass(frozen=True)
class Dataset:
    """Windows by the name of their split.

    Attributes:
        metadata: JSON values. `config` determines the windows; the rest (versions, counts, …) describes them.
        origin: the file it was read from, for messages.
    """

    splits: Mapping[str, Trajectories]
    metadata: Mapping[str, Any]
    origin: str = field(default="dataset", compare=False)

    @property
    def config(self) -> Mapping[str, Any]:
        """The configuration that determines the windows."""
        return self.metadata.get("config", {})

    def first(self, split: str, count: int | None = None) -> Trajectories:
        """The first `count` windows of a split, or all. Larger subsets contain smaller ones.

        Raises:
            ValueError: there is no such split, or it has fewer windows.
        """
        if split not in self.splits:
            raise ValueError(f"{self.origin}: has no split {split!r}, only {', '.join(self.splits)}")
        windows = self.splits[split]
        if count is not None and not 1 <= count <= len(windows):
            raise ValueError(f"{self.origin}: {count} windows of split {split!r} asked for, it has {len(windows)}")
        return windows[:count]


def save_dataset(path: str | Path, dataset: Dataset, overwrite: bool = False) -> None:
    """Write a dataset atomically. If the file already has these windows and this configuration, it is left unchanged.

    Raises:
        ValueError: windows are malformed, windows of a vehicle have no unit quaternions, metadata are not JSON, or the
            file exists with other content and `overwrite` is false.
        OSError: the file cannot be written.
    """
    path = Path(path)
    _check_splits(path, dataset)
    if path.exists() and not overwrite:
        content = content_hash(dataset)
        with suppress(ValueError):
            if content_hash(load_dataset(path)) == content:
                return
        raise ValueError(f"{path}: exists with other content; choose another path or pass overwrite=True")
    header = {"about": dataset.metadata, "splits": _split_table(dataset)}
    save_archive(path, FORMAT, header, _named_arrays(dataset))


def load_dataset(path: str | Path, expected_config: Mapping[str, Any] | None = None) -> Dataset:
    """Read and verify a dataset.

    Args:
        expected_config: entries that its configuration must have; it may have others.

    Raises:
        ValueError: the file is missing, damaged or not a dataset, or of another configuration; one line that names the
            file and every entry that differs.
    """
    header, arrays = load_archive(path, FORMAT)
    try:
        splits = {
            name: Trajectories(*(arrays[f"{name}/{part}"] for part in ARRAYS), dt=float(entry["dt"]))
            for name, entry in header["splits"].items()
        }
        dataset = Dataset(splits, dict(header["about"]), origin=str(path))
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: not a complete dataset: lacks {first_line(error)}") from error
    _check_splits(path, dataset)
    expected = expected_config or {}
    wanted, found = _flatten(expected), _flatten({key: dataset.config.get(key) for key in expected})
    differing = [
        f"{key} is {found.get(key, 'absent')}, expected {wanted.get(key, 'absent')}"
        for key in sorted(found.keys() | wanted.keys())
        if found.get(key) != wanted.get(key)
    ]
    if differing:
        raise ValueError(f"{path}: other configuration: {'; '.join(differing)}")
    return dataset


def content_hash(dataset: Dataset) -> str:
    """SHA-256 (hex) of the configuration and all windows."""
    return digest([dataset.config, _split_table(dataset)], _named_arrays(dataset))


def versions(*packages: str) -> dict[str, str]:
    """The version of Python and of each package, or "not installed"."""
    found = {"python": platform.python_version()}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def _check_splits(path: Path | str, dataset: Dataset) -> None:
    if not isinstance(dataset.config, Mapping):
        raise ValueError(f"{path}: config must be a mapping, got {type(dataset.config).__name__}")
    for name, windows in dataset.splits.items():
        check(windows, f"{path}: split {name!r}")
        if "vehicle" in dataset.config:
            check_attitudes(windows, f"{path}: split {name!r}")


def _split_table(dataset: Dataset) -> dict[str, Any]:
    return {name: {"dt": dataset.splits[name].dt} for name in sorted(dataset.splits)}


def _named_arrays(dataset: Dataset) -> dict[str, np.ndarray]:
    places = ((name, part) for name in sorted(dataset.splits) for part in ARRAYS)
    return {f"{name}/{part}": np.asarray(getattr(dataset.splits[name], part)) for name, part in places}


def _flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested keys joined by dots → the value as JSON, which does not distinguish tuples from lists."""
    flat = {}
    for key, value in config.items():
        nested = isinstance(value, Mapping)
        flat |= _flatten(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": encode(value).decode()}
    return flat
