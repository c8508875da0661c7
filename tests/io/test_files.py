"""Saved models and data sets are bit for bit the same when loaded; what is no such file is refused in one line."""

import errno
import os
import secrets
import time
import warnings
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import pendulum, swings
from surface import refusal

import hybrid_jax as hj
from experiments.runner.run_record import record_in
from hybrid_jax import IRIS, Hybrid, load, residual_network, rollout_batch, save
from hybrid_jax.dynamics.rigid_body import perturbed
from hybrid_jax.flights.formats.column_map import load_column_map
from hybrid_jax.io import models
from hybrid_jax.io.datasets import Dataset, content_hash, load_dataset, save_dataset
from hybrid_jax.io.files import save_archive, to_numpy, write_atomic
from hybrid_jax.io.structure import Structure
from hybrid_jax.networks.mlp import InputScaling

KEY = jax.random.key(0)
PHYSICS = perturbed(IRIS, KEY)
NETWORK = residual_network(13, 4, KEY, hidden=6, scaling=InputScaling(IRIS.hover_speed, 65.6))


def refused(path):
    return refusal(lambda: load(path), path)


def test_a_loaded_model_predicts_as_the_saved_one_and_says_what_it_is(tmp_path):
    field, about = Hybrid(PHYSICS, NETWORK), {"seed": 3, "test_mse": 0.5}
    save(tmp_path / "model.npz", field, about)
    model = load(tmp_path / "model.npz")
    assert model.about == about
    rng = np.random.default_rng(0)
    x0, u = np.zeros((3, 13), np.float32), np.asarray(rng.uniform(500, 800, (3, 5, 4)), np.float32)
    x0[:, 3], x0[:, 7:] = 1, rng.normal(size=(3, 6))
    predicted = model.predict(x0, u, 0.01)
    np.testing.assert_array_equal(predicted, rollout_batch(field, x0, u, 0.01))
    # A single window sums in another order.
    np.testing.assert_allclose(model.predict(x0[1], u[1], 0.01), predicted[1], rtol=1e-4, atol=1e-5)
    with jax.enable_x64(True):  # scalars and precision are kept
        save(tmp_path / "model.npz", pendulum(0.1))
        found = load(tmp_path / "model.npz").field.log_length
        assert (found, found.shape, found.dtype) == (pendulum(0.1).log_length, (), np.float64)


def test_other_files_are_refused(tmp_path):
    assert "no such file" in refused(tmp_path / "none.npz")
    other = tmp_path / "other.npz"
    save_archive(other, "hybrid_jax dataset 1", {}, {"x": np.zeros(3)})
    assert "hybrid_jax model" in refused(other)
    for metadata in ({}, [1], {"field": 3, "about": {}}, {"field": {"array": "gone"}, "about": {}}):
        save_archive(other, models.FORMAT, metadata, {})
        assert "not a complete model" in refused(other)
    body = {"class": "hybrid_jax.dynamics.rigid_body:RigidBody", "fields": {"mass": 1}}
    save_archive(other, models.FORMAT, {"field": body, "about": {}}, {})
    assert "has fields deviations, vehicle, terms, wrench, but the file has mass" in refused(other)
    # A vehicle is checked, too.
    tree = Structure(PHYSICS).tree
    tree["fields"]["vehicle"]["fields"]["mass"] = -1.0
    arrays = {f"field/deviations/{name}": to_numpy(value) for name, value in PHYSICS.deviations.items()}
    save_archive(other, models.FORMAT, {"field": tree, "about": {}}, arrays)
    assert "mass must be a positive" in refused(other)


@pytest.mark.parametrize("load", [hj.load, load_dataset, hj.load_vehicle, load_column_map, record_in])
def test_what_is_no_regular_file_is_refused_and_not_waited_for(load, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "nowhere").symlink_to(tmp_path / "none")
    for path in (*tmp_path.iterdir(), Path("/dev/zero"), tmp_path):
        refusal(lambda path=path: load(path), path)


def test_nothing_is_written_through_a_link_and_nothing_is_left(tmp_path, monkeypatch):
    """Where another user may write: a link in the place of the file, or of the one that is written first."""
    victim, path = tmp_path / "victim", tmp_path / "out" / "file"
    victim.write_text("mine")
    path.parent.mkdir()
    path.symlink_to(victim)
    write_atomic(path, "new")
    assert (path.read_text(), victim.read_text(), path.is_symlink()) == ("new", "mine", False)
    monkeypatch.setattr(secrets, "token_hex", lambda _: "0" * 16)
    (planted := path.with_name(f".{'0' * 16}.part")).symlink_to(victim)
    with pytest.raises(OSError, match="cannot be saved"):
        write_atomic(path, "newer")
    assert (path.read_text(), victim.read_text()) == ("new", "mine")
    planted.unlink(missing_ok=True)
    (left := path.with_name(f".{'1' * 16}.part")).touch()
    (other := path.with_name(".notes.part")).touch()
    for each in (left, other):
        os.utime(each, (0, 0))
    write_atomic(path, "newest")
    assert {*path.parent.iterdir()} == {path, other}


@pytest.mark.parametrize("spoil", [lambda w: w.at[0, 0].set(jnp.nan), lambda w: w[:2], lambda w: w.astype(int)])
def test_weights_that_are_not_finite_or_of_another_shape_or_type_are_refused(spoil, tmp_path):
    field = hj.residual_network(13, 4, jax.random.key(0), hidden=4)
    spoiled = eqx.tree_at(lambda field: field.weight_in, field, spoil(field.weight_in))
    with warnings.catch_warnings(action="ignore"):  # of what cannot be loaded
        hj.save(tmp_path / "model.npz", spoiled)
    refusal(lambda: hj.load(tmp_path / "model.npz"), "model.npz", "must be")


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


def not_loaded(file, **expected):
    return refusal(lambda: load_dataset(file, **expected), file)


def test_a_round_trip_leaves_all_as_it_was_and_equal_content_gives_equal_bytes(file, dataset, tmp_path, monkeypatch):
    loaded = load_dataset(file, CONFIG)
    assert content_hash(loaded) == content_hash(dataset)
    assert eqx.tree_equal(dict(loaded.splits), dict(dataset.splits))
    assert all(split.x.dtype == np.float32 for split in loaded.splits.values())
    monkeypatch.setattr(time, "time", lambda: 2e9)
    turned = replace(dataset, splits=dict(reversed(dataset.splits.items())))
    save_dataset(tmp_path / "again.npz", turned)
    assert (tmp_path / "again.npz").read_bytes() == file.read_bytes()


def test_another_configuration_names_the_fields_that_differ_and_overwriting_is_explicit(file, dataset):
    other = {**CONFIG, "seed": 1, "vehicle": {"mass": 1.6, "inertia": [0.1, 0.2, 0.3]}}
    message = not_loaded(file, expected_config=other)
    assert "seed is 0, expected 1" in message
    assert "vehicle.mass is 1.5, expected 1.6" in message
    assert "inertia" not in message
    assert load_dataset(file, {"seed": 0}).config == load_dataset(file).config  # others may be there
    assert "horizon is null, expected 3" in not_loaded(file, expected_config={"horizon": 3})
    before = file.read_bytes()
    save_dataset(file, dataset)
    other = replace(dataset, splits={"train": windows(3)})
    refusal(lambda: save_dataset(file, other), "exists with other content")
    assert file.read_bytes() == before


def test_malformed_windows_are_not_saved_and_an_interrupted_write_leaves_no_file(tmp_path, dataset, monkeypatch):
    broken = windows(4)
    broken.x[2, 3, 1] = np.nan
    with pytest.raises(ValueError, match=r"split 'train'.*\[2, 3, 1\]"):
        save_dataset(tmp_path / "a.npz", replace(dataset, splits={"train": broken}))
    with pytest.raises(ValueError, match="JSON"):
        save_dataset(tmp_path / "a.npz", replace(dataset, metadata={"config": {"a": float("nan")}}))
    assert not list(tmp_path.iterdir())

    def full_disk(_):
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="no space"):
        save_dataset(tmp_path / "a.npz", dataset)
    assert not list(tmp_path.iterdir())
