"""Datasets of windows, each in one archive."""

import platform
from collections.abc import Mapping
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
    """Named splits of windows.

    Attributes:
        splits: windows by name.
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
        if _has_content(path, content_hash(dataset)):
            return
        raise ValueError(f"{path}: exists with other content; choose another path or pass overwrite=True")
    header = {"about": dataset.metadata, "splits": _split_table(dataset)}
    save_archive(path, FORMAT, header, _named_arrays(dataset))


def load_dataset(path: str | Path, expected_config: Mapping[str, Any] | None = None) -> Dataset:
    """Read and verify a dataset.

    Raises:
        ValueError: the file is missing, damaged or not a dataset, or its configuration is not the expected one; one
            line that names the file.
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
    if expected_config is not None:
        require_config(path, dataset.config, expected_config)
    return dataset


def content_hash(dataset: Dataset) -> str:
    """SHA-256 (hex) of the configuration and all windows."""
    return digest([dataset.config, _split_table(dataset)], _named_arrays(dataset))


def config_hash(config: Mapping[str, Any]) -> str:
    """SHA-256 (hex) of a configuration. The order of keys does not matter."""
    return digest(config, {})


def versions(*packages: str) -> dict[str, str]:
    """The version of Python and of each package, or "not installed"."""
    return {"python": platform.python_version()} | {package: _version(package) for package in packages}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


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


def _has_content(path: Path, digest: str) -> bool:
    try:
        return content_hash(load_dataset(path)) == digest
    except ValueError:
        return False


def require_config(path: str | Path, found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Compare two configurations.

    Raises:
        ValueError: they differ; one line that names the file and every field that differs.
    """
    found, expected = _flatten(found), _flatten(expected)
    differing = [
        f"{key} is {found.get(key, 'absent')}, expected {expected.get(key, 'absent')}"
        for key in sorted(found.keys() | expected.keys())
        if found.get(key) != expected.get(key)
    ]
    if differing:
        raise ValueError(f"{path}: other configuration: {'; '.join(differing)}")


def _flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested keys joined by dots → the value as JSON, which does not distinguish tuples from lists."""
    flat = {}
    for key, value in config.items():
        nested = isinstance(value, Mapping)
        flat |= _flatten(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": encode(value).decode()}
    return flat
