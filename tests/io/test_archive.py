"""Files that another wrote end in one line with their name, whatever they hold; what is written is written whole."""

import os
import secrets
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.flights.formats.column_map import load_column_map
from hybrid_jax.io.datasets import load_dataset
from hybrid_jax.io.files import read_json, write_atomic


@pytest.mark.parametrize("load", [hj.load, load_dataset, hj.load_vehicle, load_column_map, read_json])
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


def test_models_side_by_side_are_loaded(tmp_path):
    keys = jax.random.split(jax.random.key(0), 3)
    fields = eqx.filter_vmap(lambda key: hj.residual_network(13, 4, key, hidden=4))(keys)
    hj.save(tmp_path / "models.npz", fields)
    assert eqx.tree_equal(hj.load(tmp_path / "models.npz").field, fields)
