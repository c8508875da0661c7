"""Lanes: scheduled on devices so that none waits, and traced once."""

import equinox as eqx
import numpy as np
import pytest

from hybrid_jax.sweep.lanes import LaneMap, count, lane, load_balance, schedule, stack


def test_lanes_are_stacked_and_picked():
    lanes = [{"x": np.full(2, i), "n": np.int32(i), "name": "all alike"} for i in range(3)]
    stacked = stack(lanes)
    assert count(stacked) == 3
    assert eqx.tree_equal(lane(stacked, 1), lanes[1] | {"n": np.asarray(lanes[1]["n"])})
    assert lane(stacked, 1)["n"].shape == ()


def test_a_number_is_a_constant_of_all_lanes():
    fields = [{"k": np.float32(i), "mass": 2.0} for i in range(3)]
    assert stack(fields)["mass"] == 2.0
    with pytest.raises(ValueError, match=r"lanes: 2.0 must be an array if it differs between lanes"):
        stack([*fields, {"k": np.float32(3), "mass": 3.0}])


@pytest.mark.parametrize(("devices", "width"), [(1, 1), (2, 1), (3, 2), (4, 5)])
def test_schedule_is_complete_and_balanced(devices, width):
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


def test_more_devices_than_lanes_leave_some_idle():
    assert [shard.tolist() for shard in schedule([3.0, 1.0], [1], 3, 1, 1)] == [[1], [], []]


def test_schedule_respects_the_capacity_of_a_device():
    costs = [100.0, *[1.0] * 9]
    assert [len(shard) for shard in schedule(costs, range(10), 2, 1, 10)] == [1, 9]
    assert [len(shard) for shard in schedule(costs, range(10), 2, 1, 6)] == [4, 6]
    assert [len(shard) for shard in schedule(costs, range(10), 2, 2, 3)] == [4, 6]


@pytest.mark.parametrize(("devices", "width"), [(1, 1), (2, 1), (3, 2), (4, 5), (4, 30)])
def test_load_balance_equalises_the_work_of_devices(devices, width):
    rng = np.random.default_rng(1)
    costs, active = rng.uniform(1, 10, 40), sorted(rng.permutation(40)[:33].tolist())
    shards = schedule(costs, active, devices, width, 40)
    times = load_balance(shards, costs, width)
    busy = [sum(costs[i] * times[i] for i in shard[::width]) for shard in shards if len(shard)]
    assert busy == pytest.approx([max(busy)] * len(busy))
    assert times[active].min() == 1
    assert not np.delete(times, active).any()


@pytest.mark.parametrize("width", [1, 3])
def test_a_lane_is_traced_once(width):
    traced = []

    def function(lane, shared):
        traced.append(lane)
        return lane * shared

    mapped = LaneMap(function, width)
    lanes = np.arange(4, dtype=np.float32)
    for active in ([0, 1, 2, 3], [2]):
        np.testing.assert_array_equal(mapped(lanes, (np.float32(2),), np.ones(4), active), 2 * lanes[active])
    assert len(traced) == 1
