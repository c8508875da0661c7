"""Laws of a training run, on a pendulum of unknown length or damping, of `fit` on all systems, and of stages."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from pendulum import DAMPING, LENGTH, pendulum, swings
from surface import is_finite
from systems import Dense

from hybrid_jax import Hybrid, Settings, Stage, fit, fit_in_stages, rates_by_group, residual_network
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.networks.mlp import zero_output
from hybrid_jax.networks.standardise import with_motion, with_scaling
from hybrid_jax.status import Status
from hybrid_jax.sweep import stack, sweep
from hybrid_jax.training.driver import FitInterrupted
from hybrid_jax.training.fitting import make_run_config, run, start
from hybrid_jax.training.loss import trajectory_correlation

SETTINGS = Settings(batch_size=20)
TRAIN, VALIDATION = swings(60), swings(40, seed=1)
KEY = jax.random.key(0)
_run = eqx.filter_jit(run)


def trained(field, rates=0.03, key=KEY, train=TRAIN, validation=VALIDATION, settings=SETTINGS, **rules):
    rules = {"min_epochs": 10, "patience": 10, "max_epochs": 60} | rules
    return fit(field, train, validation, key, rates=rates, settings=settings, **rules)


def validated(field):
    return float(eqx.filter_jit(rollout_mse)(field, VALIDATION))


@pytest.fixture(scope="module")
def damped():
    """The run that most laws are read off: the right damping, the wrong length."""
    return trained(pendulum(0.8, DAMPING))


@pytest.fixture(scope="module")
def hybrid():
    """An undamped pendulum of another length, and a network for what it lacks."""
    field = Hybrid(pendulum(0.6), residual_network(2, 1, jax.random.key(1), hidden=16))
    settings = Settings(20, trajectory_correlation)
    return field, trained(field, Hybrid(0.03, 0.01), settings=settings, max_epochs=150, min_epochs=150)


def test_an_unknown_length_is_recovered_and_the_key_decides_the_order_of_minibatches(damped):
    # The data are the model's own up to float32; Adam at 0.03 with minibatches hovers within a few 1e-3 of it.
    np.testing.assert_allclose(np.exp(damped.best.log_length), LENGTH, rtol=1e-2)
    assert damped.best_mse < 1e-3 * validated(pendulum(0.8, DAMPING))
    again, other = (trained(pendulum(0.8, DAMPING), key=key) for key in (KEY, jax.random.key(5)))
    assert again.field.log_length == damped.field.log_length
    assert other.field.log_length != damped.field.log_length


def test_a_hybrid_of_one_s_own_learns_and_predicts(hybrid):
    field, state = hybrid
    # What physics alone can do with its length free is the measure of what the network adds.
    physics_only = trained(field.physics)
    assert state.best_mse < 0.2 * physics_only.best_mse
    np.testing.assert_allclose(np.exp(state.best.physics.log_length), LENGTH, rtol=0.1)
    assert rollout_mse(state.best, swings(30, seed=2)) < 4 * state.best_mse  # windows never seen, of the same kind
    # The network has learned the damping itself, at rest and within what was flown.
    rates = jnp.array([-2.0, -1.0, 1.0, 2.0])
    push = jax.vmap(lambda rate: state.best(jnp.array([0.0, rate]), jnp.zeros(1))[1])(rates)
    np.testing.assert_allclose(push, -DAMPING * rates, atol=0.5)


def test_running_statistics_move_a_part_with_rate_zero_does_not_and_exact_physics_needs_no_residual(hybrid):
    field, _ = hybrid
    state = trained(field, Hybrid(0.03, 0.0), max_epochs=3)
    for name in ("weight_in", "weight_out", "bias_out"):
        np.testing.assert_array_equal(getattr(state.field.residual, name), getattr(field.residual, name))
    np.testing.assert_array_equal(state.field.residual.norm.gain, field.residual.norm.gain)
    assert (state.field.residual.norm.running.mean != field.residual.norm.running.mean).all()
    assert state.field.physics.log_length != field.physics.log_length
    field, push = Hybrid(pendulum(), zero_output(hybrid[0].residual)), {}
    for damping in (0.0, DAMPING):
        flown, others = swings(60, damping=damping), swings(40, seed=1, damping=damping)
        state = trained(field, Hybrid(0.0, 3e-3), train=flown, validation=others, max_epochs=40, min_epochs=40)
        forces = jax.vmap(state.best.residual)(flown.x0, flown.u[:, 0])[:, 1]
        push[damping] = float(jnp.sqrt(jnp.mean(jnp.square(forces))))
    # Adam turns even a gradient of round-off into steps of the rate, so silence is not exact; a force is far louder.
    assert push[0.0] < 0.02
    assert push[DAMPING] > 0.1


def test_the_best_epoch_is_the_best_that_validation_saw():
    whole = trained(pendulum(0.8, DAMPING), max_epochs=15)
    state = start(pendulum(0.8, DAMPING), KEY)
    plan = make_run_config(0.03, jnp.arange(60), 60, 10, 10, 15, 1e-3)
    errors, fields = [], []
    for until in range(1, 16):
        state, _ = _run(state, plan, TRAIN, VALIDATION, SETTINGS, jnp.asarray(until))
        errors.append(validated(state.field))
        fields.append(state.field)
    best = int(np.argmin(errors))
    assert int(whole.best_epoch) == best + 1
    np.testing.assert_array_equal(whole.best.log_length, fields[best].log_length)
    np.testing.assert_allclose(whole.best_mse, errors[best], rtol=1e-4)  # another program for the same sums
    # Run in one go or in blocks, the run is the same, and its history is that of every epoch.
    np.testing.assert_allclose(whole.history.validation, errors, rtol=1e-4)
    assert whole.history.train[-1] == state.train_loss
    np.testing.assert_array_equal(state.field.log_length, whole.field.log_length)


def test_it_stops_when_patience_is_spent_and_not_before_the_minimum(damped):
    # With a rate of zero the first epoch is the best for ever: the error did not fall, and nothing converged.
    still = trained(pendulum(LENGTH, DAMPING), 0.0, patience=5)
    for state, minimum, patience, status in ((damped, 10, 10, Status.OK), (still, 10, 5, Status.STALLED)):
        assert state.status == status
        assert state.epochs == max(minimum, state.best_epoch + patience)
    assert still.best_epoch == 1
    for rules, *end in (({"min_epochs": 0, "patience": 7}, Status.STALLED, 8), ({"max_epochs": 7}, Status.CAPPED, 7)):
        state = trained(pendulum(LENGTH, DAMPING), 0.0, **rules)
        assert [state.status, state.epochs] == end


def test_each_epoch_sees_every_window_once_but_only_the_first_n_train_of_the_subset():
    field, subset = pendulum(0.8, DAMPING), np.random.default_rng(0).permutation(60)
    for key in (KEY, jax.random.key(1)):
        state = trained(field, 0.0, key=key, max_epochs=1)
        np.testing.assert_allclose(state.history.train[0], rollout_mse(field, TRAIN), rtol=1e-5)  # float32 sums

    def planned(subset=subset, train=TRAIN):
        plan = make_run_config(0.03, subset, 40, 100, 100, 4, 0.0)
        return _run(start(field, KEY), plan, train, VALIDATION, SETTINGS, jnp.asarray(4))[0]

    used, unused = subset[:40], subset[40:]
    spoiled = eqx.tree_at(lambda w: w.x, TRAIN, TRAIN.x.at[unused].set(jnp.nan))
    touched = eqx.tree_at(lambda w: w.x, TRAIN, TRAIN.x.at[used[7]].add(0.1))
    assert eqx.tree_equal(planned(train=spoiled), planned())
    assert eqx.tree_equal(planned(np.concatenate([used, unused[::-1]])), planned())
    assert not eqx.tree_equal(planned(train=touched), planned())


def test_a_field_with_leaves_that_are_no_arrays_trains_and_an_optax_optimiser_moves_one_as_adam_does():
    field = Dense(eqx.nn.MLP(3, 2, 16, 1, activation=lambda z: jax.nn.softplus(z), key=KEY))
    with pytest.warns(UserWarning, match="activation is the callable .*, which is not `hybrid_jax.portable`"):
        state = trained(field, 0.01, max_epochs=40)
    assert state.best_mse < 0.5 * validated(field)
    assert state.best.network.activation is field.network.activation
    field = pendulum(0.8, DAMPING)
    usual, inside, outside = (
        trained(field, rates, max_epochs=3, optimiser=optimiser)
        for rates, optimiser in ((0.03, None), (None, optax.adam(0.03)), (0.03, optax.adam(1.0)))
    )
    for other in (inside, outside):
        np.testing.assert_allclose(other.field.log_length, usual.field.log_length, rtol=1e-5)


def test_a_huge_rate_or_windows_that_turn_bad_end_the_run_as_diverged_with_the_last_good_field(hybrid):
    state = trained(hybrid[0], Hybrid(0.0, 1e30), max_epochs=30)
    assert (state.status, state.epochs < 30) == (Status.DIVERGED, True)
    assert jnp.isfinite(state.best_mse) == (state.best_epoch > 0)
    assert is_finite(state.best)
    plan = make_run_config(0.03, jnp.arange(60), 60, 10, 10, 60, 0.0)
    good, _ = _run(start(pendulum(0.8, DAMPING), KEY), plan, TRAIN, VALIDATION, SETTINGS, jnp.asarray(3))
    spoiled = eqx.tree_at(lambda w: w.x, TRAIN, jnp.full_like(TRAIN.x, jnp.inf))
    bad, _ = _run(good, plan, spoiled, VALIDATION, SETTINGS, jnp.asarray(20))
    assert (int(bad.status), int(bad.epoch)) == (Status.DIVERGED, 4)
    assert eqx.tree_equal(bad.best, good.best)
    assert bad.best_mse == good.best_mse


def test_double_precision_trains_alone_and_in_a_sweep():
    with jax.enable_x64(True):
        given = pendulum(0.8), TRAIN, VALIDATION
        field, train, validation = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), given)
        alone = trained(field, train=train, validation=validation, max_epochs=3)
        plans = stack([make_run_config(rate, jnp.arange(60), 60, 10, 10, 3, 1e-3) for rate in (0.01, 0.03)])
        lanes = sweep(stack([start(field, KEY)] * 2), plans, train, validation, SETTINGS, width=1)
    assert (alone.state.status.dtype, alone.status) == (np.int32, Status.CAPPED)
    assert alone.best.log_length.dtype == alone.best_mse.dtype == np.float64
    # Another program for the same sums, in the round-off of double precision.
    np.testing.assert_allclose(lanes.field.log_length[1], alone.field.log_length, rtol=0, atol=1e-12)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("exact", [True, False])
def test_a_field_in_single_precision_trains_on_windows_of_numpy_in_double_without_a_warning(exact):
    """Also where JAX computes in double precision."""
    field = pendulum(0.8)
    for norm in ("batch", "layer", "none"):
        field = Hybrid(field, residual_network(2, 1, KEY, hidden=4, norm=norm))
    field = jax.tree.map(np.asarray, field)
    with jax.enable_x64(exact):
        train, validation = (jax.tree.map(lambda leaf: np.asarray(leaf, float), w) for w in (TRAIN, VALIDATION))
        best = trained(field, train=train, validation=validation, max_epochs=1).best
    assert {leaf.dtype for leaf in jax.tree.leaves(eqx.filter(best, eqx.is_array))} == {np.dtype(np.float32)}


def test_ctrl_c_between_blocks_keeps_the_run_so_far_and_progress_is_shown_on_stderr_only_when_asked_for(capsys):
    def stop(epoch, state):
        if epoch >= 3:
            raise KeyboardInterrupt

    with pytest.raises(FitInterrupted) as stopped:
        trained(pendulum(0.8, DAMPING), progress=stop)
    result = stopped.value.result
    assert (result.status, len(result.history.validation)) == (Status.RUNNING, result.epochs)
    assert result.best_mse == np.float32(result.history.validation.min())
    for progress in (None, True):
        trained(pendulum(0.8, DAMPING), max_epochs=2, progress=progress)
        said = capsys.readouterr()
        assert (said.out, "2/2" in said.err) == ("", bool(progress))


@cache
def staged():
    network = zero_output(residual_network(2, 1, jax.random.key(1), hidden=8, norm="none"))
    return with_motion(with_scaling(Hybrid(pendulum(0.6), network), TRAIN), TRAIN)


def in_stages(stages, field=None, train=TRAIN, **options):
    return fit_in_stages(field or staged(), train, VALIDATION, KEY, stages, settings=SETTINGS, **options)


def test_groups_that_are_not_named_do_not_move_and_the_longest_that_fits_counts():
    physics = in_stages([Stage({"physics": 0.03}, epochs=5)])[-1].best
    assert physics.physics.log_length != staged().physics.log_length
    assert eqx.tree_equal(physics.residual, staged().residual)
    output = in_stages([Stage({"residual": 0.01, "residual/weight_in": 0.0}, epochs=5)])[-1].best
    assert eqx.tree_equal(output.physics, staged().physics)
    assert eqx.tree_equal(output.residual.weight_in, staged().residual.weight_in)
    assert (output.residual.weight_out != staged().residual.weight_out).all()
    rates = rates_by_group(staged(), {"": 1e-3, "residual": 1e-2, "residual/norm": 0.0})
    assert rates.physics.log_length == np.float32(1e-3)
    assert rates.residual.weight_in == np.float32(1e-2)
    assert rates.residual.norm.shift == 0
    assert eqx.tree_equal(make_run_config(rates, jnp.arange(3), 3, 0, 1, 1, 0.0).rates, rates)  # what a sweep takes
    with pytest.raises(ValueError, match="no learned array begins with 'resid'; the paths are physics/log_length"):
        rates_by_group(staged(), {"resid": 1.0})


def test_stages_go_on_from_each_other_and_the_start_is_kept_where_nothing_is_better():
    stages = [Stage({"physics": 0.03}, steps=2, epochs=30), Stage({"": 0.01}, epochs=60)]
    first, second = in_stages(stages)
    start = float(rollout_mse(staged(), VALIDATION))
    assert second.best_mse < first.best_mse < start
    np.testing.assert_allclose(first.best_mse, rollout_mse(first.best, VALIDATION), rtol=1e-5)
    assert second.best_mse < 0.5 * first.best_mse  # the damping is the network's
    # Physics that is exact, trained on windows of another pendulum, as a residual that only learns noise would be.
    exact = pendulum(LENGTH, DAMPING)
    state = in_stages([Stage({"": 0.05}, epochs=5)], exact, train=swings(60, length=2.0))[-1]
    assert eqx.tree_equal(state.best, exact)
    assert (state.best_epoch, state.epochs) == (0, 5)
    assert state.field.log_length != exact.log_length
