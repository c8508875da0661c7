"""Saved models of this library: bit for bit the same when loaded, or refused in one line."""

import equinox as eqx
import jax
import numpy as np
import pytest
import surface
from pendulum import pendulum

from hybrid_jax import IRIS, Hybrid, load, residual_network, rollout_batch, save
from hybrid_jax.dynamics.rigid_body import perturbed
from hybrid_jax.io import models
from hybrid_jax.io.archive import save_archive, to_numpy
from hybrid_jax.io.structure import Structure
from hybrid_jax.networks.mlp import InputScaling

KEY = jax.random.key(0)
PHYSICS = perturbed(IRIS, KEY)
NETWORK = residual_network(13, 4, KEY, hidden=6, scaling=InputScaling(IRIS.hover_speed, 65.6))
FIELDS = {"physics": PHYSICS, "network": NETWORK, "hybrid": Hybrid(PHYSICS, NETWORK)}
_direct = eqx.filter_jit(rollout_batch)


def refusal(path):
    return surface.refusal(lambda: load(path), path)


@pytest.mark.parametrize("name", FIELDS)
def test_a_loaded_model_is_the_saved_one(name, tmp_path):
    save(tmp_path / "model.npz", FIELDS[name], {"seed": 3, "test_mse": 0.5})
    model = load(tmp_path / "model.npz")
    assert eqx.tree_equal(model.field, FIELDS[name])
    assert type(model.field) is type(FIELDS[name])
    assert model.about == {"seed": 3, "test_mse": 0.5}
    rng = np.random.default_rng(0)
    x0, u = np.zeros((3, 13), np.float32), np.asarray(rng.uniform(500, 800, (3, 5, 4)), np.float32)
    x0[:, 3], x0[:, 7:] = 1, rng.normal(size=(3, 6))
    predicted = model.predict(x0, u, 0.01)
    np.testing.assert_array_equal(predicted, _direct(FIELDS[name], x0, u, 0.01))
    # A single window sums in another order.
    np.testing.assert_allclose(model.predict(x0[1], u[1], 0.01), predicted[1], rtol=1e-4, atol=1e-5)


def test_scalars_and_precision_are_kept(tmp_path):
    with jax.enable_x64(True):
        field = pendulum(0.1)
        assert field.log_length.dtype == np.float64
        save(tmp_path / "model.npz", field)
        found = load(tmp_path / "model.npz").field.log_length
        assert (found.shape, found.dtype) == ((), np.float64)
        assert found == field.log_length


def test_other_files_are_refused(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.npz")
    other = tmp_path / "other.npz"
    save_archive(other, "hybrid_jax dataset 1", {}, {"x": np.zeros(3)})
    assert "hybrid_jax model" in refusal(other)
    for metadata in ({}, [1], {"field": 3, "about": {}}, {"field": {"array": "gone"}, "about": {}}):
        save_archive(other, models.FORMAT, metadata, {})
        assert "not a complete model" in refusal(other)
    body = {"class": "hybrid_jax.dynamics.rigid_body:RigidBody", "fields": {"mass": 1}}
    save_archive(other, models.FORMAT, {"field": body, "about": {}}, {})
    assert "has fields deviations, vehicle, terms, wrench, but the file has mass" in refusal(other)


def test_a_vehicle_in_a_file_is_checked(tmp_path):
    tree = Structure(PHYSICS).tree
    tree["fields"]["vehicle"]["fields"]["mass"] = -1.0
    arrays = {f"field/deviations/{name}": to_numpy(value) for name, value in PHYSICS.deviations.items()}
    save_archive(tmp_path / "model.npz", models.FORMAT, {"field": tree, "about": {}}, arrays)
    assert "mass must be a positive" in refusal(tmp_path / "model.npz")
