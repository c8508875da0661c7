"""Laws of training in stages."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import DAMPING, LENGTH, pendulum, swings

from hybrid_jax import Hybrid, Settings, Stage, fit_in_stages, rates_by_group, residual_network
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.networks.mlp import zero_output
from hybrid_jax.networks.standardise import with_motion, with_scaling
from hybrid_jax.training.fitting import make_run_config

TRAIN, VALIDATION, KEY = swings(60), swings(40, seed=1), jax.random.key(0)
SETTINGS = Settings(batch_size=20)


@cache
def hybrid():
    network = zero_output(residual_network(2, 1, jax.random.key(1), hidden=8, norm="none"))
    return with_motion(with_scaling(Hybrid(pendulum(0.6), network), TRAIN), TRAIN)


def trained(stages, field=None, train=TRAIN, **options):
    return fit_in_stages(field or hybrid(), train, VALIDATION, KEY, stages, settings=SETTINGS, **options)


def test_groups_that_are_not_named_do_not_move():
    physics = trained([Stage({"physics": 0.03}, epochs=5)])[-1].best
    assert physics.physics.log_length != hybrid().physics.log_length
    assert eqx.tree_equal(physics.residual, hybrid().residual)
    output = trained([Stage({"residual": 0.01, "residual/weight_in": 0.0}, epochs=5)])[-1].best
    assert eqx.tree_equal(output.physics, hybrid().physics)
    assert eqx.tree_equal(output.residual.weight_in, hybrid().residual.weight_in)
    assert (output.residual.weight_out != hybrid().residual.weight_out).all()


def test_the_longest_group_that_fits_counts():
    rates = rates_by_group(hybrid(), {"": 1e-3, "residual": 1e-2, "residual/norm": 0.0})
    assert rates.physics.log_length == np.float32(1e-3)
    assert rates.residual.weight_in == np.float32(1e-2)
    assert rates.residual.norm.shift == 0
    assert eqx.tree_equal(make_run_config(rates, jnp.arange(3), 3, 0, 1, 1, 0.0).rates, rates)  # what a sweep takes
    with pytest.raises(ValueError, match="no learned array begins with 'resid'; the paths are physics/log_length"):
        rates_by_group(hybrid(), {"resid": 1.0})


def test_stages_go_on_from_each_other_and_never_get_worse():
    stages = [Stage({"physics": 0.03}, steps=2, epochs=30), Stage({"": 0.01}, epochs=60)]
    first, second = trained(stages)
    start = float(rollout_mse(hybrid(), VALIDATION))
    assert second.best_mse < first.best_mse < start
    np.testing.assert_allclose(first.best_mse, rollout_mse(first.best, VALIDATION), rtol=1e-5)
    assert second.best_mse < 0.5 * first.best_mse  # the damping is the network's


def test_the_start_is_kept_where_nothing_is_better():
    """Physics that is exact, trained on windows of another pendulum, as a residual that only learns noise would be."""
    exact = pendulum(LENGTH, DAMPING)
    state = trained([Stage({"": 0.05}, epochs=5)], exact, train=swings(60, length=2.0))[-1]
    assert eqx.tree_equal(state.best, exact)
    assert (state.best_epoch, state.epochs) == (0, 5)
    assert state.field.log_length != exact.log_length
