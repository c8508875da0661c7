"""Sets of windows as one file each: no pickle, checked by its own checksum, the same bytes for the same content."""

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
    """Named splits and where they come from.

    Attributes:
        splits: windows by name.
        metadata: JSON values; `config` is what fixed the windows, the rest (versions, tallies, …) describes them.
        origin: the file it was read from, for messages.
    """

    splits: Mapping[str, Trajectories]
    metadata: Mapping[str, Any]
    origin: str = field(default="dataset", compare=False)

    @property
    def config(self) -> Mapping[str, Any]:
        """What fixed the windows."""
        return self.metadata.get("config", {})

    def first(self, split: str, count: int | None = None) -> Trajectories:
        """The first `count` windows of a split, or all: subsets of growing count are nested.

        Raises:
            ValueError: no such split, or it has fewer windows.
        """
        if split not in self.splits:
            raise ValueError(f"{self.origin}: has no split {split!r}, only {', '.join(self.splits)}")
        windows = self.splits[split]
        if count is not None and not 1 <= count <= len(windows):
            raise ValueError(f"{self.origin}: {count} windows of split {split!r} asked for, it has {len(windows)}")
        return windows[:count]


def save_dataset(path: str | Path, dataset: Dataset, overwrite: bool = False) -> None:
    """Write a dataset, whole or not at all. Saving the same windows and configuration again leaves the file as it is.

    Raises:
        ValueError: windows are malformed, or those of a vehicle have no unit quaternions; metadata are not JSON; or the
            file exists with other content and `overwrite` is off.
        OSError: the folder cannot be written.
    """
    path = Path(path)
    _check_splits(path, dataset)
    if path.exists() and not overwrite:
        if _has_content(path, content_hash(dataset)):
            return
        raise ValueError(f"{path}: exists with other content; choose another name or say that it may be overwritten")
    header = {"about": dataset.metadata, "splits": _split_table(dataset)}
    save_archive(path, FORMAT, header, _named_arrays(dataset))


def load_dataset(path: str | Path, expected_config: Mapping[str, Any] | None = None) -> Dataset:
    """Read a dataset and verify it.

    Raises:
        ValueError: the file is missing, truncated, not a dataset, damaged, malformed, or of a configuration other than
            the expected one; one line that names the file and what is wrong.
    """
    header, arrays = load_archive(path, FORMAT)
    try:
        splits = {
            name: Trajectories(*(arrays[f"{name}/{part}"] for part in ARRAYS), dt=float(entry["dt"]))
            for name, entry in header["splits"].items()
        }
        dataset = Dataset(splits, dict(header["about"]), origin=str(path))
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: not a whole dataset: lacks {first_line(error)}") from error
    _check_splits(path, dataset)
    if expected_config is not None:
        require_config(path, dataset.config, expected_config)
    return dataset


def content_hash(dataset: Dataset) -> str:
    """SHA-256 (hex) over configuration, names, types, shapes, dt and bytes of all windows."""
    return digest([dataset.config, _split_table(dataset)], _named_arrays(dataset))


def config_hash(config: Mapping[str, Any]) -> str:
    """SHA-256 (hex) of a configuration, whatever the order of its keys."""
    return digest(config, {})


def versions(*packages: str) -> dict[str, str]:
    """Python and the installed versions of packages; a package that is not installed reads 'not installed'."""
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
    return {
        f"{name}/{part}": np.ascontiguousarray(getattr(dataset.splits[name], part))
        for name in sorted(dataset.splits)
        for part in ARRAYS
    }


def _has_content(path: Path, digest: str) -> bool:
    try:
        return content_hash(load_dataset(path)) == digest
    except ValueError:
        return False


def require_config(path: str | Path, found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Compare two configurations.

    Raises:
        ValueError: they differ; one line that names the file and shows every field that does.
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
    """Nested keys joined by dots → the value as JSON, in which a tuple and a list are the same."""
    flat = {}
    for key, value in config.items():
        nested = isinstance(value, Mapping)
        flat |= _flatten(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": encode(value).decode()}
    return flat
