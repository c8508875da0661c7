"""Laws of Expert Augmentation, on a pendulum whose length an encoder reads off the past."""

import equinox as eqx
import jax
import numpy as np
import pytest
from pendulum import LENGTH, pendulum, swings

from experiments.paper.expert_augmentation import Augmentation, expert_augmented, prediction_mse
from hybrid_jax import Hybrid, Settings, fit, load, residual_network, rollout, save
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.networks import zero_output
from hybrid_jax.trajectories import split

PAST = 6
SETTINGS = Settings(100, objective=Augmentation(PAST, seed=3))
KEY = jax.random.key(0)


def flights(count, seed, length=LENGTH):
    """Windows of an undamped pendulum: the past, then as many intervals to predict."""
    return swings(count, steps=2 * PAST, seed=seed, damping=0.0, length=length)


WINDOWS = flights(1000, seed=0)


def expert(box=(0.5, 2.0), hidden=32):
    """An untrained network that says nothing about the right length: the source model could not be better."""
    silent = zero_output(residual_network(2, 1, KEY, hidden=4))
    return expert_augmented(Hybrid(pendulum(), silent), split(WINDOWS, PAST)[0], KEY, box=box, hidden=hidden)


@pytest.fixture(scope="module")
def trained():
    rules = {"min_epochs": 60, "patience": 20, "max_epochs": 60, "regulariser_weight": 1.0}
    validation = flights(100, seed=1)
    return fit(expert(), WINDOWS, validation, KEY, rates=3e-3, settings=SETTINGS, **rules).best


@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_what_is_read_moves_to_a_changed_vehicle_and_predicts_it(trained, factor):
    target = flights(200, seed=4, length=factor * LENGTH)
    read = np.exp(jax.vmap(trained.estimate)(split(target, PAST)[0]))[:, 0]
    assert np.median(read) == pytest.approx(factor * LENGTH, rel=0.1)
    mean = np.exp(trained.typical(split(target, PAST)[0]).physics.log_length)
    assert mean == pytest.approx(factor * LENGTH, rel=0.1)
    alone = rollout_mse(trained.expert.field, split(target, PAST)[1])
    assert prediction_mse(trained, target, PAST) < 0.5 * alone


def test_a_box_of_one_point_leaves_the_source_model():
    point = expert(box=(1.0, 1.0))
    past, future = split(WINDOWS, PAST)
    predicted = jax.vmap(point.predict)(past, future.u)
    alone = jax.vmap(lambda x0, u: rollout(point.expert.field, x0, u, WINDOWS.dt))(future.x0, future.u)
    np.testing.assert_array_equal(predicted, alone)


@pytest.mark.parametrize("size", [1.0, 1e6])
def test_no_past_leads_out_of_the_box(size):
    wild = jax.tree.map(lambda leaf: size * leaf, split(WINDOWS, PAST)[0])
    found = np.asarray(jax.vmap(expert().estimate)(wild))
    assert (np.abs(found - np.log(LENGTH)) <= np.log(2) + 1e-6).all()


def test_the_expert_stays_as_it_is_the_whole_survives_a_file_and_bad_input_is_refused(trained, tmp_path):
    assert eqx.tree_equal(trained.expert, expert().expert)
    save(tmp_path / "model.npz", trained)
    model = load(tmp_path / "model.npz")
    assert eqx.tree_equal(model.field, trained)
    with pytest.raises(ValueError, match="the model is a ExpertAugmented, which needs more than x0 and u"):
        model.predict(WINDOWS.x0, WINDOWS.u, WINDOWS.dt)
    with pytest.raises(ValueError, match=r"train: windows of 12 intervals, more than past=12 expected"):
        Augmentation(12).prepare(WINDOWS, "train")
