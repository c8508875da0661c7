"""Laws of one training run, on a pendulum whose length or damping is unknown, and of `fit` on all systems."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from pendulum import DAMPING, LENGTH, pendulum, swings
from systems import Dense

from hybrid_jax import Hybrid, Settings, fit, residual_network
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.networks.mlp import zero_output
from hybrid_jax.status import Status
from hybrid_jax.sweep import stack, sweep
from hybrid_jax.training.driver import FitInterrupted
from hybrid_jax.training.fitting import make_run_config, run, start
from hybrid_jax.training.loss import trajectory_correlation

BATCH = 20
SETTINGS = Settings(batch_size=BATCH)
TRAIN, VALIDATION = swings(60), swings(40, seed=1)
KEY = jax.random.key(0)
_run = eqx.filter_jit(run)


def trained(field, rates=0.03, key=KEY, train=TRAIN, validation=VALIDATION, settings=SETTINGS, **rules):
    rules = {"min_epochs": 10, "patience": 10, "max_epochs": 60} | rules
    return fit(field, train, validation, key, rates=rates, settings=settings, **rules)


def planned(field, subset, n_train, train=TRAIN, epochs=4):
    plan = make_run_config(0.03, subset, n_train, 100, 100, epochs, 0.0)
    return _run(start(field, KEY), plan, train, VALIDATION, SETTINGS, jnp.asarray(epochs))[0]


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
    settings = Settings(BATCH, trajectory_correlation)
    return field, trained(field, Hybrid(0.03, 0.01), settings=settings, max_epochs=150, min_epochs=150)


def test_an_unknown_length_is_recovered(damped):
    # The data are the model's own up to float32; Adam at 0.03 with minibatches hovers within a few 1e-3 of it.
    np.testing.assert_allclose(np.exp(damped.best.log_length), LENGTH, rtol=1e-2)
    assert damped.best_mse < 1e-3 * validated(pendulum(0.8, DAMPING))


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


def test_running_statistics_move_while_a_part_with_rate_zero_does_not(hybrid):
    field, _ = hybrid
    state = trained(field, Hybrid(0.03, 0.0), max_epochs=3)
    for name in ("weight_in", "weight_out", "bias_out"):
        np.testing.assert_array_equal(getattr(state.field.residual, name), getattr(field.residual, name))
    np.testing.assert_array_equal(state.field.residual.norm.gain, field.residual.norm.gain)
    assert (state.field.residual.norm.running.mean != field.residual.norm.running.mean).all()
    assert state.field.physics.log_length != field.physics.log_length


def test_exact_physics_leaves_a_silent_residual_silent(hybrid):
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


def test_the_key_decides_the_order_of_minibatches(damped):
    again, other = (trained(pendulum(0.8, DAMPING), key=key) for key in (KEY, jax.random.key(5)))
    assert again.field.log_length == damped.field.log_length
    assert other.field.log_length != damped.field.log_length


def test_only_the_first_n_train_of_the_subset_are_used():
    subset = np.random.default_rng(0).permutation(60)
    used, unused = subset[:40], subset[40:]
    spoiled = eqx.tree_at(lambda w: w.x, TRAIN, TRAIN.x.at[unused].set(jnp.nan))
    field = pendulum(0.8, DAMPING)
    plain = planned(field, subset, 40)
    assert eqx.tree_equal(planned(field, subset, 40, spoiled), plain)
    assert eqx.tree_equal(planned(field, np.concatenate([used, unused[::-1]]), 40), plain)
    touched = eqx.tree_at(lambda w: w.x, TRAIN, TRAIN.x.at[used[7]].add(0.1))
    assert not eqx.tree_equal(planned(field, subset, 40, touched), plain)


def test_each_epoch_sees_every_window_once():
    field = pendulum(0.8, DAMPING)
    for key in (KEY, jax.random.key(1)):
        state = trained(field, 0.0, key=key, max_epochs=1)
        np.testing.assert_allclose(state.history.train[0], rollout_mse(field, TRAIN), rtol=1e-5)  # float32 sums


def test_a_field_with_leaves_that_are_no_arrays_trains():
    field = Dense(eqx.nn.MLP(3, 2, 16, 1, activation=lambda z: jax.nn.softplus(z), key=KEY))
    with pytest.warns(UserWarning, match="activation is the callable .*, which is not `hybrid_jax.portable`"):
        state = trained(field, 0.01, max_epochs=40)
    assert state.best_mse < 0.5 * validated(field)
    assert state.best.network.activation is field.network.activation


def test_a_huge_rate_ends_the_run_as_diverged_with_a_finite_field(hybrid):
    state = trained(hybrid[0], Hybrid(0.0, 1e30), max_epochs=30)
    assert state.status == Status.DIVERGED
    assert state.epochs < 30
    assert jnp.isfinite(state.best_mse) == (state.best_epoch > 0)
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(eqx.filter(state.best, eqx.is_array)))


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


def test_a_field_in_single_precision_trains_on_windows_in_double():
    field = pendulum(0.8)
    for norm in ("batch", "layer", "none"):
        field = Hybrid(field, residual_network(2, 1, KEY, hidden=4, norm=norm))
    with jax.enable_x64(True):
        train, validation = (jax.tree.map(lambda leaf: jnp.asarray(leaf, float), w) for w in (TRAIN, VALIDATION))
        best = trained(field, train=train, validation=validation, max_epochs=1).best
    assert {leaf.dtype for leaf in jax.tree.leaves(eqx.filter(best, eqx.is_array))} == {np.dtype(np.float32)}


@pytest.mark.filterwarnings("error")
def test_arrays_of_numpy_are_taken_without_a_warning(hybrid):
    field = jax.tree.map(np.asarray, hybrid[0])
    train, validation = (jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), w) for w in (TRAIN, VALIDATION))
    assert trained(field, train=train, validation=validation, max_epochs=1).epochs == 1


def test_windows_that_turn_bad_after_a_good_epoch_leave_that_epoch():
    plan = make_run_config(0.03, jnp.arange(60), 60, 10, 10, 60, 0.0)
    good, _ = _run(start(pendulum(0.8, DAMPING), KEY), plan, TRAIN, VALIDATION, SETTINGS, jnp.asarray(3))
    spoiled = eqx.tree_at(lambda w: w.x, TRAIN, jnp.full_like(TRAIN.x, jnp.inf))
    bad, _ = _run(good, plan, spoiled, VALIDATION, SETTINGS, jnp.asarray(20))
    assert (int(bad.status), int(bad.epoch)) == (Status.DIVERGED, 4)
    assert eqx.tree_equal(bad.best, good.best)
    assert bad.best_mse == good.best_mse


def test_an_optax_optimiser_moves_a_field_as_adam_does():
    field = pendulum(0.8, DAMPING)
    usual, inside, outside = (
        trained(field, rates, max_epochs=3, optimiser=optimiser)
        for rates, optimiser in ((0.03, None), (None, optax.adam(0.03)), (0.03, optax.adam(1.0)))
    )
    for other in (inside, outside):
        np.testing.assert_allclose(other.field.log_length, usual.field.log_length, rtol=1e-5)


def test_ctrl_c_between_blocks_keeps_the_run_so_far():
    def stop(epoch, state):
        if epoch >= 3:
            raise KeyboardInterrupt

    with pytest.raises(FitInterrupted) as stopped:
        trained(pendulum(0.8, DAMPING), progress=stop)
    result = stopped.value.result
    assert (result.status, len(result.history.validation)) == (Status.RUNNING, result.epochs)
    assert result.best_mse == np.float32(result.history.validation.min())


def test_progress_is_shown_on_stderr_only_when_asked_for(capsys):
    for progress in (None, True):
        trained(pendulum(0.8, DAMPING), max_epochs=2, progress=progress)
        said = capsys.readouterr()
        assert (said.out, "2/2" in said.err) == ("", bool(progress))
