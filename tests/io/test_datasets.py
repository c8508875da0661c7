"""Laws of dataset files."""

import errno
import os
import time
from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
import surface
from pendulum import swings

from hybrid_jax.io.datasets import Dataset, content_hash, load_dataset, save_dataset

CONFIG = {"domain": "source", "seed": 0, "vehicle": {"mass": 1.5, "inertia": (0.1, 0.2, 0.3)}}


def windows(*size):
    return jax.tree.map(np.array, swings(*size))


@pytest.fixture
def dataset():
    metadata = {"config": CONFIG, "versions": {"jax": "1"}}
    return Dataset({"train": windows(20), "test": windows(5, 100, 1)}, metadata)


@pytest.fixture
def file(tmp_path, dataset):
    path = tmp_path / "set.npz"
    save_dataset(path, dataset)
    return path


def refusal(file, **expected):
    return surface.refusal(lambda: load_dataset(file, **expected), file)


def test_round_trip(file, dataset):
    loaded = load_dataset(file, CONFIG)
    assert content_hash(loaded) == content_hash(dataset)
    assert eqx.tree_equal(dict(loaded.splits), dict(dataset.splits))
    assert all(split.x.dtype == np.float32 for split in loaded.splits.values())


def test_equal_content_gives_equal_bytes(file, dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(time, "time", lambda: 2e9)
    turned = replace(dataset, splits=dict(reversed(dataset.splits.items())))
    save_dataset(tmp_path / "again.npz", turned)
    assert (tmp_path / "again.npz").read_bytes() == file.read_bytes()


def test_another_configuration_names_the_fields_that_differ(file):
    message = refusal(file, expected_config={**CONFIG, "seed": 1, "vehicle": {"mass": 1.6, "inertia": [0.1, 0.2, 0.3]}})
    assert "seed is 0, expected 1" in message
    assert "vehicle.mass is 1.5, expected 1.6" in message
    assert "inertia" not in message
    assert load_dataset(file, {"seed": 0}).config == load_dataset(file).config  # others may be there
    assert "horizon is null, expected 3" in refusal(file, expected_config={"horizon": 3})


def test_overwriting_is_explicit(file, dataset):
    before = file.read_bytes()
    save_dataset(file, dataset)
    other = replace(dataset, splits={"train": windows(3)})
    with pytest.raises(ValueError, match="exists with other content"):
        save_dataset(file, other)
    assert file.read_bytes() == before


def test_an_interrupted_write_leaves_no_file(tmp_path, dataset, monkeypatch):
    def full_disk(_):
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="no space"):
        save_dataset(tmp_path / "a.npz", dataset)
    assert not list(tmp_path.iterdir())


def test_malformed_windows_and_metadata_are_not_saved(tmp_path, dataset):
    broken = windows(4)
    broken.x[2, 3, 1] = np.nan
    with pytest.raises(ValueError, match=r"split 'train'.*\[2, 3, 1\]"):
        save_dataset(tmp_path / "a.npz", replace(dataset, splits={"train": broken}))
    with pytest.raises(ValueError, match="JSON"):
        save_dataset(tmp_path / "a.npz", replace(dataset, metadata={"config": {"a": float("nan")}}))
    assert not list(tmp_path.iterdir())
