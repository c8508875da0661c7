"""Laws of lanes: dealt to devices so that none waits, in chunks that fit into memory, by a function traced once."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from hybrid_jax.sweep.lanes import LaneMap, count, deal, lane, slack, stack


def test_lanes_are_stacked_and_picked():
    lanes = [{"x": np.full(2, i), "n": np.int32(i), "name": "all alike"} for i in range(3)]
    stacked = stack(lanes)
    assert count(stacked) == 3
    assert eqx.tree_equal(lane(stacked, 1), lanes[1] | {"n": np.asarray(lanes[1]["n"])})
    assert lane(stacked, 1)["n"].shape == ()


@pytest.mark.parametrize(("devices", "width"), [(1, 1), (2, 1), (3, 2), (4, 5)])
def test_dealing_gives_every_lane_once_and_balances(devices, width):
    rng = np.random.default_rng(0)
    costs, active = rng.uniform(1, 10, 40), sorted(rng.permutation(40)[:33].tolist())
    hands = deal(costs, active, devices, width, 40)
    assert len(hands) == devices
    assert sorted(np.concatenate(hands).tolist()) == active
    chunks = [[hand[i : i + width] for i in range(0, len(hand), width)] for hand in hands]
    loads = [sum(max(costs[chunk]) for chunk in hand) for hand in chunks]
    # Dearest first to the idlest: two devices never differ by more than one chunk.
    assert max(loads) - min(loads) <= max(costs)
    assert all(np.diff(costs[hand]).max(initial=-1) <= 0 for hand in hands)


def test_more_devices_than_lanes_leave_some_idle():
    assert [hand.tolist() for hand in deal([3.0, 1.0], [1], 3, 1, 1)] == [[1], [], []]


def test_no_device_is_dealt_more_chunks_than_it_has_room_for():
    costs = [100.0, *[1.0] * 9]
    assert [len(hand) for hand in deal(costs, range(10), 2, 1, 10)] == [1, 9]
    assert [len(hand) for hand in deal(costs, range(10), 2, 1, 6)] == [4, 6]
    assert [len(hand) for hand in deal(costs, range(10), 2, 2, 3)] == [4, 6]


@pytest.mark.parametrize(("devices", "width"), [(1, 1), (2, 1), (3, 2), (4, 5), (4, 30)])
def test_a_device_with_less_to_do_is_given_as_much_more(devices, width):
    rng = np.random.default_rng(1)
    costs, active = rng.uniform(1, 10, 40), sorted(rng.permutation(40)[:33].tolist())
    hands = deal(costs, active, devices, width, 40)
    times = slack(hands, costs, width)
    busy = [sum(costs[i] * times[i] for i in hand[::width]) for hand in hands if len(hand)]
    assert busy == pytest.approx([max(busy)] * len(busy))
    assert times[active].min() == 1
    assert not np.delete(times, active).any()


def test_a_chunk_is_halved_until_its_program_fits_into_memory():
    """A lane sorts a megabyte on its way; the programs of both widths give the same."""
    lanes, shared = {"x": np.arange(8, dtype=np.float32)}, (np.ones(2**18, np.float32),)

    def function(lane, ones):
        return jnp.sum(jnp.sort(ones * lane["x"]))

    whole = LaneMap(function, width=0)
    assert whole._needed(8, lanes, shared) > whole._needed(2, lanes, shared) > 2 * shared[0].nbytes
    narrow = LaneMap(function, width=0, memory=int(whole._needed(2, lanes, shared)))
    results = [mapped(lanes, shared, [1.0] * 8, range(8)) for mapped in (whole, narrow)]
    assert [mapped._width(lanes, shared) for mapped in (whole, narrow)] == [8, 2]
    np.testing.assert_allclose(results[0], results[1], rtol=1e-6)


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
