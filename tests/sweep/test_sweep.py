"""Laws of many runs as one program: lanes do not touch, stop alone, are compiled once, and no device waits."""

import logging
import os
from dataclasses import replace

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from choices import slow
from pendulum import DAMPING, pendulum, swings

from hybrid_jax.metrics import rollout_mse
from hybrid_jax.status import Status
from hybrid_jax.sweep.lanes import LaneMap, count, lane, load_balance, schedule, stack
from hybrid_jax.sweep.training import evaluate, evaluate_windows, sweep
from hybrid_jax.training import Settings, fitting
from hybrid_jax.training.fitting import make_run_config, start

SETTINGS = Settings(batch_size=10)
TRAIN, VALIDATION = swings(40), swings(20, seed=1)
LENGTHS = (0.8, 0.7, 0.6)


def plan(rate=0.03, n_train=20, minimum=5, cap=12, seed=0):
    subset = np.random.default_rng(seed).permutation(40)
    return make_run_config(rate, subset, n_train, minimum, 3, cap, 0.0)


def starts(lengths=LENGTHS):
    return stack([start(pendulum(length, DAMPING), jax.random.key(i)) for i, length in enumerate(lengths)])


PLANS = [plan(0.03, 20, seed=1), plan(0.01, 40, seed=2), plan(0.05, 10, cap=6, seed=3)]


def swept(states, plans, train=TRAIN, validation=VALIDATION, settings=SETTINGS, **options):
    return sweep(states, stack(plans), train, validation, settings, **options)


def same(one, other):
    return eqx.tree_equal(*(jax.tree.map(np.asarray, eqx.filter(each, eqx.is_array)) for each in (one, other)))


@pytest.fixture(scope="module")
def final():
    return swept(starts(), PLANS, width=1)


@pytest.mark.skipif("level=0" in os.environ["XLA_FLAGS"], reason="rounds otherwise, not optimised: test_optimised.py")
def test_a_lane_is_the_same_run_alone(final):
    """Bit for bit where a chunk is one lane, whichever lanes stand beside it and in which order they are dealt."""
    for i in range(3):
        alone = swept(lane(starts(), np.array([i])), PLANS[i : i + 1], width=1)
        assert same(lane(alone, 0), lane(final, i))
    turned = swept(lane(starts(), np.array([2, 0, 1])), [PLANS[2], PLANS[0], PLANS[1]], width=1)
    assert same(lane(turned, np.array([1, 2, 0])), final)


def test_a_lane_is_a_run_by_the_plain_function(final):
    for i in range(3):
        state = start(pendulum(LENGTHS[i], DAMPING), jax.random.key(i))
        alone, _ = eqx.filter_jit(fitting.run)(state, PLANS[i], TRAIN, VALIDATION, SETTINGS, jnp.asarray(1000))
        here = lane(final, i)
        assert (alone.epoch, alone.status, alone.best_epoch) == (here.epoch, here.status, here.best_epoch)
        # Another program for the same sums: round-off, grown over some 50 steps.
        np.testing.assert_allclose(here.field.log_length, alone.field.log_length, rtol=0, atol=1e-5)


@pytest.mark.parametrize("solver", [diffrax.Heun(), *slow(diffrax.Tsit5())], ids=["heun", "tsit5"])
def test_a_sweep_trains_through_the_solvers_of_diffrax(solver, final):
    other = swept(starts(), PLANS, width=1, settings=replace(SETTINGS, solver=solver))
    assert not same(other.field, final.field)
    # The steps of 0.05 are short, so that the solver's error is all that is between them.
    np.testing.assert_allclose(other.field.log_length, final.field.log_length, rtol=0, atol=0.02)


@pytest.mark.parametrize("width", [2, *slow(3)])
def test_lanes_that_share_a_chunk_are_the_same_runs(width, final):
    together = swept(starts(), PLANS, width=width)
    np.testing.assert_array_equal(together.status, final.status)
    # vmap orders sums differently: round-off, grown over some 50 steps.
    np.testing.assert_allclose(together.field.log_length, final.field.log_length, rtol=0, atol=1e-5)
    np.testing.assert_allclose(together.best_mse, final.best_mse, rtol=1e-2, atol=1e-8)


def test_every_lane_comes_to_its_own_end(final):
    assert set(final.status) <= {Status.OK, Status.CAPPED}
    assert (final.epoch[2], final.status[2]) == (6, Status.CAPPED)
    assert (final.epoch <= 12).all()
    assert same(swept(final, PLANS, width=1), final)  # and once all have stopped nothing moves


def compilations(caplog):
    """How many programs of sweeps were compiled under jax.log_compiles."""
    messages = [record.getMessage() for record in caplog.records]
    return sum("Finished XLA compilation" in message and "jit(_on_mesh)" in message for message in messages)


def test_one_compilation_serves_all_sizes_rates_and_blocks(caplog):
    blocks = []
    own = replace(SETTINGS, batch_size=5)  # no other test's, or its compilation would serve here too
    given = {"width": 1, "block_seconds": 1e-9, "on_block": lambda *each: blocks.append(each)}
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        for _ in range(2):
            swept(starts(), PLANS, settings=own, **given)
    assert len(blocks) > 3
    assert compilations(caplog) == 1


def test_sweeps_of_fewer_lanes_and_windows_share_a_program(caplog, final):
    own, capacity = SETTINGS, (4, 50)  # no other test's
    states, plans = lane((starts(), stack(PLANS)), np.array([2]))
    few = states, replace(plans, subset=plans.subset % 20), TRAIN[:20]
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        shared = [
            sweep(starts(), stack(PLANS), TRAIN, VALIDATION, own, width=1, min_capacity=capacity),
            sweep(*few, VALIDATION, own, width=1, min_capacity=capacity),
        ]
        errors = [evaluate(each.best, VALIDATION, 2, own, capacity[0]) for each in shared]
    assert compilations(caplog) == 2  # one to train, one to test
    apart = [final, sweep(*few, VALIDATION, own, width=1)]
    for one, other, error in zip(shared, apart, errors, strict=True):
        np.testing.assert_array_equal(one.epoch, other.epoch)
        np.testing.assert_allclose(one.field.log_length, other.field.log_length, rtol=0, atol=1e-6)
        np.testing.assert_allclose(error, evaluate(other.best, VALIDATION, 2, own), rtol=1e-4)


@pytest.mark.parametrize("listed", [3, 40, *slow(1000)])
def test_minibatches_are_of_the_lanes_windows_however_many_are_listed(listed):
    subset, key = np.random.default_rng(0).permutation(listed), jax.random.key_data(jax.random.key(1))
    for n in {1, listed // 8, listed // 8 + 1, listed} - {0}:
        pairs = [make_run_config(0.1, np.pad(subset, (0, more)), n, 1, 1, 1, 0.0) for more in (0, 10 * listed)]
        orders = [fitting._shuffled(each, key)[:listed] for each in pairs]
        np.testing.assert_array_equal(*orders)
        assert set(np.asarray(orders[0][:n])) == set(subset[:n])
        if n > 20:
            assert (orders[0][:n] != subset[:n]).any()


@pytest.mark.parametrize("width", [1, 3])
def test_a_diverged_lane_changes_no_bit_of_another(width, final):
    """A rate of 1e3 makes the pendulum's length vanish at the first step.

    Lanes move up in a chunk when another stops, for whatever reason, and an optimised program rounds by the place.
    """
    wild, stopped = (
        swept(starts(), [PLANS[0], other, PLANS[2]], width=width)
        for other in (plan(1e3, 40, seed=2), plan(0.01, 40, minimum=1, cap=1, seed=2))
    )
    assert wild.status[1] == Status.DIVERGED
    assert np.isfinite(wild.best.log_length).all()
    for i in (0, 2):
        assert same(lane(wild, i), lane(stopped, i))
        assert width > 1 or same(lane(wild, i), lane(final, i))


def test_stopped_lanes_are_run_no_more(monkeypatch):
    handed, epochs, run = [], [], LaneMap.__call__

    def counting(self, lanes, shared, costs, active):
        handed.append(list(active))
        return run(self, lanes, shared, costs, active)

    monkeypatch.setattr(LaneMap, "__call__", counting)
    given = {"width": 1, "block_seconds": 1e-9, "on_block": lambda states, _: epochs.append(states.epoch.tolist())}
    swept(starts(), [plan(cap=1), plan(cap=9, minimum=9), plan(cap=20, minimum=20)], **given)
    assert handed[1] == [0, 1, 2]  # the first call only compiles
    assert handed[2] == [1, 2]
    assert handed[-1] == [2]
    assert len(epochs) > 3
    assert {each[0] for each in epochs} == {1}
    assert epochs[-1] == [1, 9, 20]


def test_progress_says_what_is_left():
    reports = []
    given = {"width": 1, "block_seconds": 1e-9, "on_block": lambda *report: reports.append(report)}
    swept(starts(), [plan(cap=12, minimum=12)] * 3, **given)
    for states, progress in reports:
        running = states.status == Status.RUNNING
        assert (progress.active, progress.lanes, progress.epochs) == (running.sum(), 3, states.epoch.max())
        assert progress.best == states.best_mse.min()
        assert progress.at_most == (12 - states.epoch[running]).max(initial=0)
        assert 0 <= progress.at_least <= progress.at_most


def test_evaluate_is_the_error_of_each_lane(final):
    test = swings(15, seed=2)
    errors, each = evaluate_windows(final.best, test, 2, SETTINGS)
    np.testing.assert_array_equal(evaluate(final.best, test, 2, SETTINGS), errors)
    np.testing.assert_allclose(each.mean(axis=1), errors, rtol=1e-5)
    for i in range(3):
        alone = rollout_mse(lane(final.best, i), test, 2)
        np.testing.assert_allclose(errors[i], alone, rtol=1e-4)  # another program for the same float32 sums


def test_runs_stop_by_their_own_validation_windows_and_plans_that_do_not_fit_the_data_are_refused():
    """Indices into a larger validation set do what that part of it does alone."""
    own = [replace(each, validate_on=jnp.arange(5, 15)) for each in PLANS]
    parted, alone = swept(starts(), own), swept(starts(), PLANS, validation=VALIDATION[5:15])
    np.testing.assert_array_equal(parted.best_epoch, alone.best_epoch)
    np.testing.assert_allclose(parted.best_mse, alone.best_mse, rtol=1e-4)  # another program for the same float32 sums
    wrong = replace(own[1], validate_on=own[1].validate_on.at[0].set(20))
    with pytest.raises(ValueError, match="validate_on contains 20, which is not an index of the 20 windows"):
        swept(starts(), [own[0], wrong])
    # A gather would clamp an index outside the data and train on another window in silence.
    for size in (41, 9):
        with pytest.raises(ValueError, match=f"n_train={size} must lie between batch_size=10 and .* 40 in train"):
            swept(starts(), [*PLANS[:2], plan(n_train=size)])
    for place, index in ((0, 40), (39, -1)):
        with pytest.raises(ValueError, match=f"subset contains {index}"):
            swept(starts(), [PLANS[0], replace(PLANS[1], subset=PLANS[1].subset.at[place].set(index)), PLANS[2]])
    spoiled = eqx.tree_at(lambda w: w.u, VALIDATION, VALIDATION.u.at[1, 2, 0].set(jnp.nan))
    with pytest.raises(ValueError, match=r"^validation: u\[1, 2, 0\] is not finite"):
        swept(starts(), PLANS, validation=spoiled)


def test_lanes_are_stacked_and_picked_and_a_number_is_a_constant_of_all():
    lanes = [{"x": np.full(2, i), "n": np.int32(i), "name": "all alike", "mass": 2.0} for i in range(3)]
    stacked = stack(lanes)
    assert (count(stacked), stacked["mass"]) == (3, 2.0)
    assert eqx.tree_equal(lane(stacked, 1), lanes[1] | {"n": np.asarray(lanes[1]["n"])})
    assert lane(stacked, 1)["n"].shape == ()
    with pytest.raises(ValueError, match=r"lanes: 2.0 must be an array if it differs between lanes"):
        stack([*lanes, lanes[0] | {"mass": 3.0}])


@pytest.mark.parametrize(("devices", "width"), [(1, 1), (2, 1), (3, 2), (4, 5), (4, 30)])
def test_schedule_is_complete_and_balanced_and_load_balance_equalises_the_work(devices, width):
    rng = np.random.default_rng(0)
    costs, active = rng.uniform(1, 10, 40), sorted(rng.permutation(40)[:33].tolist())
    shards = schedule(costs, active, devices, width, 40)
    assert len(shards) == devices
    assert sorted(np.concatenate(shards).tolist()) == active
    chunks = [[shard[i : i + width] for i in range(0, len(shard), width)] for shard in shards]
    loads = [sum(max(costs[chunk]) for chunk in shard) for shard in chunks]
    # Most expensive first, to the least loaded: two devices never differ by more than one chunk.
    assert max(loads) - min(loads) <= max(costs)
    assert all(np.diff(costs[shard]).max(initial=-1) <= 0 for shard in shards)

    times = load_balance(shards, costs, width)
    busy = [sum(costs[i] * times[i] for i in shard[::width]) for shard in shards if len(shard)]
    assert busy == pytest.approx([max(busy)] * len(busy))
    assert times[active].min() == 1
    assert not np.delete(times, active).any()


def test_schedule_respects_the_capacity_of_a_device():
    costs = [100.0, *[1.0] * 9]
    assert [len(shard) for shard in schedule(costs, range(10), 2, 1, 10)] == [1, 9]
    assert [len(shard) for shard in schedule(costs, range(10), 2, 1, 6)] == [4, 6]
    assert [len(shard) for shard in schedule(costs, range(10), 2, 2, 3)] == [4, 6]
