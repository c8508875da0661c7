"""Datasets of windows, each in one archive."""

import platform
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hybrid_jax.checks import first_line
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.io.files import digest, encode, load_archive, save_archive
from hybrid_jax.trajectories import Trajectories, check

FORMAT = "hybrid_jax dataset 1"
ARRAYS = ("x0", "u", "x")


@dataclass(frozen=True)
class Dataset:
    """Windows in splits, with metadata.

    Attributes:
        splits: the windows of each split, by its name, for example "train".
        metadata: JSON values. The entry `config` should determine the windows; others may describe them.
    """

    splits: Mapping[str, Trajectories]
    metadata: Mapping[str, Any]

    @property
    def config(self) -> Mapping[str, Any]:
        """The configuration that determines the windows."""
        return self.metadata.get("config", {})


def save_dataset(path: str | Path, dataset: Dataset) -> None:
    """Write a dataset atomically. A file with the same windows and configuration is left unchanged.

    Args:
        path: the file to write.
        dataset: the windows and their metadata.

    Raises:
        ValueError: if windows are malformed or have quaternions that are not of unit length, metadata are not JSON, or
            the file exists with other content.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    _check_splits(path, dataset)
    if path.exists():
        content = content_hash(dataset)
        with suppress(ValueError):
            if content_hash(load_dataset(path)) == content:
                return
        raise ValueError(f"{path}: exists with other content; choose another path, or remove it")
    splits, arrays = _content(dataset)
    save_archive(path, FORMAT, {"about": dataset.metadata, "splits": splits}, arrays)


def load_dataset(path: str | Path, expected_config: Mapping[str, Any] | None = None) -> Dataset:
    """Read and verify a dataset.

    Args:
        path: a file that `save_dataset` wrote.
        expected_config: entries that the configuration must contain; None for no condition.

    Raises:
        ValueError: if the file is missing, damaged or not a dataset, or has another configuration. The message lists
            each entry that differs.
    """
    header, arrays = load_archive(path, FORMAT)
    try:
        splits = {
            name: Trajectories(*(arrays[f"{name}/{part}"] for part in ARRAYS), dt=float(entry["dt"]))
            for name, entry in header["splits"].items()
        }
        dataset = Dataset(splits, dict(header["about"]))
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: not a complete dataset: lacks {first_line(error)}") from error
    _check_splits(path, dataset)
    expected = dict(expected_config or {})
    wanted, found = _flatten(expected), _flatten({key: dataset.config.get(key) for key in expected})
    pairs = {key: (found.get(key, "absent"), wanted.get(key, "absent")) for key in sorted(found.keys() | wanted.keys())}
    differing = [f"{key} is {ours}, expected {theirs}" for key, (ours, theirs) in pairs.items() if ours != theirs]
    if differing:
        raise ValueError(f"{path}: has another configuration: {'; '.join(differing)}")
    return dataset


def content_hash(dataset: Dataset) -> str:
    """Return the SHA-256 (hex) of the configuration and all windows."""
    splits, arrays = _content(dataset)
    return digest([dataset.config, splits], arrays)


def versions(*packages: str) -> dict[str, str]:
    """Return the version of Python and of each package, or "not installed"."""
    found = {"python": platform.python_version()} | dict.fromkeys(packages, "not installed")
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _check_splits(path: Path | str, dataset: Dataset) -> None:
    if not isinstance(dataset.config, Mapping):
        raise ValueError(f"{path}: config must be a mapping, got {type(dataset.config).__name__}")
    for name, windows in dataset.splits.items():
        check(windows, f"{path}: split {name!r}")
        if "vehicle" in dataset.config and windows.x.shape[-1] == RIGID_BODY_SPACE.size:
            RIGID_BODY_SPACE.check(f"{path}: split {name!r}: x0", windows.x0)
            RIGID_BODY_SPACE.check(f"{path}: split {name!r}: x", windows.x)


def _content(dataset: Dataset) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the saved metadata of each split, and its arrays by name."""
    splits = {name: dataset.splits[name] for name in sorted(dataset.splits)}
    arrays = {f"{name}/{part}": np.asarray(getattr(splits[name], part)) for name in splits for part in ARRAYS}
    return {name: {"dt": windows.dt} for name, windows in splits.items()}, arrays


def _flatten(config: dict[str, Any]) -> dict[str, str]:
    """Map nested keys, joined by dots, to values as JSON, in which tuples and lists are equal."""
    leaves = jax.tree_util.tree_leaves_with_path(config, is_leaf=lambda node: not isinstance(node, dict))
    return {jax.tree_util.keystr(path, simple=True, separator="."): encode(value).decode() for path, value in leaves}
