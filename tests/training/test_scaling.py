"""Laws of the scaling that `fit` reads off the training windows."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from systems import SYSTEMS, Gain

import hybrid_jax as hj
from hybrid_jax.networks.mlp import LinearSkip
from hybrid_jax.networks.normalisation import ChannelScaling, InputScaling
from hybrid_jax.networks.standardise import with_scaling

KEY = jax.random.key(0)
car = SYSTEMS["car"]  # cached


@cache
def scaled():
    return with_scaling(car().model, car().train)


def samples(windows):
    before = np.concatenate([windows.x0[:, None], windows.x[:, :-1]], axis=1)
    return before.reshape(-1, before.shape[-1]), np.reshape(windows.u, (-1, windows.u.shape[-1]))


def test_every_input_has_mean_zero_and_deviation_one():
    z = jax.vmap(scaled().residual.inputs)(*samples(car().train))
    np.testing.assert_allclose(jnp.mean(z, axis=0), 0, atol=1e-3)
    np.testing.assert_allclose(jnp.std(z, axis=0), 1, rtol=1e-3)  # float32 means of hundreds


def test_a_unit_of_the_state_changes_nothing_that_the_network_reads():
    x, u = samples(car().train)
    unit = np.array([1e-3, 1, 1, 1, 1, 1], np.float32)
    windows = hj.Trajectories(car().train.x0 * unit, car().train.u, car().train.x * unit, car().train.dt)
    network = hj.residual_network(6, 2, KEY, hidden=4)
    metres, kilometres = with_scaling(network, car().train), with_scaling(network, windows)
    read = jax.vmap(kilometres.inputs)(x * unit, u)
    np.testing.assert_allclose(jax.vmap(metres.inputs)(x, u), read, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(kilometres.scaling.output[0], 1e-3 * metres.scaling.output[0], rtol=1e-3)


def test_a_scaling_that_was_given_or_set_stays():
    given = hj.residual_network(6, 2, KEY, scaling=InputScaling(1.0, 2.0))
    for field in (given, scaled(), car().model.physics):
        assert with_scaling(field, car().validation) is field


def test_networks_inside_other_fields_are_scaled():
    network = hj.residual_network(6, 2, KEY, hidden=4)
    for field in (Gain(jnp.zeros(()), network), LinearSkip(jnp.zeros((6, 8)), network)):
        scaling = with_scaling(hj.Hybrid(car().model.physics, field), car().train).residual.field.scaling
        assert scaling == scaled().residual.scaling


def test_constant_channels_are_left_their_size():
    still = eqx.tree_at(lambda w: w.u, car().train, jnp.zeros_like(car().train.u))
    assert with_scaling(car().model, still).residual.scaling.scale[-2:] == (1.0, 1.0)


def test_training_leaves_the_scaling_and_a_file_keeps_it(tmp_path):
    trained = hj.fit(car().model, car().train, car().validation, KEY, max_epochs=2).best
    kept = trained.residual.scaling
    assert replace(kept, learned_from=None) == scaled().residual.scaling != ChannelScaling()
    hj.save(tmp_path / "car.npz", trained)
    found = hj.load(tmp_path / "car.npz").field
    assert eqx.tree_equal(found, trained)
    np.testing.assert_array_equal(found.residual.scaling.learned_from.x[-1], car().train.x[-1])
