"""Laws of what makes training independent of units: the scaling that `fit` reads off windows, and the scaled loss."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pendulum import pendulum, swings
from surface import refusal
from systems import SYSTEMS, Gain

import hybrid_jax as hj
from hybrid_jax.networks.mlp import LinearSkip
from hybrid_jax.networks.normalisation import ChannelScaling, InputScaling
from hybrid_jax.training.objective import TrajectoryLoss, scaled_loss

KEY = jax.random.key(0)
car = SYSTEMS["car"]  # cached


@cache
def scaled():
    return hj.with_scaling(car().model, car().train)


def samples(windows):
    before = np.concatenate([windows.x0[:, None], windows.x[:, :-1]], axis=1)
    return before.reshape(-1, before.shape[-1]), np.reshape(windows.u, (-1, windows.u.shape[-1]))


def test_every_input_has_mean_zero_and_deviation_one_and_a_unit_of_the_state_changes_nothing():
    z = jax.vmap(scaled().residual.inputs)(*samples(car().train))
    np.testing.assert_allclose(jnp.mean(z, axis=0), 0, atol=1e-3)
    np.testing.assert_allclose(jnp.std(z, axis=0), 1, rtol=1e-3)  # float32 means of hundreds
    x, u = samples(car().train)
    unit = np.array([1e-3, 1, 1, 1, 1, 1], np.float32)
    windows = hj.Trajectories(car().train.x0 * unit, car().train.u, car().train.x * unit, car().train.dt)
    network = hj.residual_network(6, 2, KEY, hidden=4)
    metres, kilometres = hj.with_scaling(network, car().train), hj.with_scaling(network, windows)
    read = jax.vmap(kilometres.inputs)(x * unit, u)
    np.testing.assert_allclose(jax.vmap(metres.inputs)(x, u), read, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(kilometres.scaling.output[0], 1e-3 * metres.scaling.output[0], rtol=1e-3)


def test_networks_inside_other_fields_are_scaled_constant_channels_and_a_scaling_that_was_given_left():
    still = eqx.tree_at(lambda w: w.u, car().train, jnp.zeros_like(car().train.u))
    assert hj.with_scaling(car().model, still).residual.scaling.scale[-2:] == (1.0, 1.0)
    network = hj.residual_network(6, 2, KEY, hidden=4)
    for field in (Gain(jnp.zeros(()), network), LinearSkip(jnp.zeros((6, 8)), network)):
        scaling = hj.with_scaling(hj.Hybrid(car().model.physics, field), car().train).residual.field.scaling
        assert scaling == scaled().residual.scaling
    given = hj.residual_network(6, 2, KEY, scaling=InputScaling(1.0, 2.0))
    for field in (given, scaled(), car().model.physics):
        assert hj.with_scaling(field, car().validation) is field


def test_training_leaves_the_scaling_and_a_file_keeps_it(tmp_path):
    trained = hj.fit(car().model, car().train, car().validation, KEY, max_epochs=2).best
    kept = trained.residual.scaling
    assert replace(kept, learned_from=None) == scaled().residual.scaling != ChannelScaling()
    hj.save(tmp_path / "car.npz", trained)
    found = hj.load(tmp_path / "car.npz").field
    assert eqx.tree_equal(found, trained)
    np.testing.assert_array_equal(found.residual.scaling.learned_from.x[-1], car().train.x[-1])


TRAIN, VALIDATION = swings(60), swings(40, seed=1)
FIELD = pendulum(0.8)


def loss(objective, windows, field=FIELD):
    return objective.loss(field, objective.batch(windows, hj.Settings()), hj.Settings(), 0.0)[0]


def test_a_scale_counts_errors_in_its_units_and_those_of_a_field_are_its_changes_over_a_window():
    """States without a scale of their own do not count; windows are predicted whole, and in chunks."""
    many = jax.tree.map(lambda leaf: np.tile(leaf, (26, *(1,) * (leaf.ndim - 1))), VALIDATION)
    for scale in ((1.0, 1.0), (0.5, 2.0), (0.5, np.inf)):
        objective, unit = TrajectoryLoss(scale), np.array(scale)
        errors = hj.rollout_batch(FIELD, VALIDATION.x0, VALIDATION.u, VALIDATION.dt) - VALIDATION.x
        expected = np.mean(np.sum(np.square(errors / unit), axis=-1))
        np.testing.assert_allclose(loss(objective, VALIDATION), expected, rtol=1e-5)
        for data in (VALIDATION, many):
            np.testing.assert_allclose(objective.validate(FIELD, data, hj.Settings()), expected, rtol=1e-5)
    last = (TRAIN.x - TRAIN.x0[:, None])[:, -1]
    counted = last / np.array(scaled_loss(FIELD, TRAIN).scale)
    np.testing.assert_allclose(np.square(counted).sum(axis=-1).mean(), 2.0, rtol=1e-5)  # two quantities
    half = jax.tree.map(lambda leaf: leaf / 2, eqx.tree_at(lambda w: w.u, TRAIN, TRAIN.x))
    np.testing.assert_allclose(last / 2 / np.array(scaled_loss(FIELD, half).scale), counted, rtol=1e-5)
    for scale in ((1.0, 0.0), (np.nan,), [1.0]):
        refusal(lambda scale=scale: TrajectoryLoss(scale), "scale must")
    refusal(lambda: TrajectoryLoss((1.0,) * 3).prepare(TRAIN, "train"), "train: states of 3")
