"""Laws of groups: a lane of a group is the lone lane, and a group computes what its own kind needs and no more."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.closed_loop.lane_groups import LaneGroups
from hybrid_jax.sweep.lanes import LaneMap, count, lane


def vectors(*values):
    return {"x": np.array([[value, 2 * value] for value in values], np.float32)}


def scalars(*values):
    return {"x": np.array(values, np.float32)}


def lone(one, factor):
    return {"sum": factor * jnp.sum(one["x"]), "twice": factor * jnp.array([1.0, 2.0]) * jnp.max(one["x"])}


CALLS = [[vectors(1, 2, 3), scalars(4), vectors(5, 6)], [scalars(7), vectors(8)], [vectors(9)]]


@pytest.mark.parametrize("width", [1, 2, 3, 10])
def test_every_lane_gets_its_own_result_from_one_program(width):
    traced = []

    def function(one, factor):
        traced.append(one["x"].shape)
        return lone(one, factor)

    groups = LaneGroups(CALLS, width)
    run = LaneMap(groups.mapped(function), 1, min_capacity=groups.room)
    for stacks in CALLS:
        grouped, where = groups.grouped(stacks)
        assert count(grouped) <= groups.room
        costs = groups.costs(grouped)
        found = run(grouped, (np.float32(10.0),), costs, range(len(costs)))
        each = [lone(lane(lanes, i), 10.0) for lanes in stacks for i in range(count(lanes))]
        for name in ("sum", "twice"):
            expected = np.stack([result[name] for result in each])
            np.testing.assert_allclose(found[name][where[:, 0], where[:, 1]], expected, rtol=1e-6)
    assert sorted(traced) == [(), (2,)]  # each kind once, whatever was called


def test_groups_are_of_one_kind_and_full_but_for_the_last():
    groups = LaneGroups(CALLS, 4)
    grouped, where = groups.grouped(CALLS[0])
    assert grouped.kind.tolist() == [0, 0, 1]
    assert where.tolist() == [[0, 0], [0, 1], [0, 2], [2, 0], [0, 3], [1, 0]]
    assert groups.costs(grouped).tolist() == [4, 4, 1]  # no call has two scalars: theirs are groups of one
    assert groups.room == 3


def test_only_the_branch_of_its_kind_runs():
    """What another kind needs is not computed and thrown away, as it would be under vmap."""
    ran = []

    def function(one):
        jax.debug.callback(lambda x: ran.append(x.shape), one["x"])
        return jnp.sum(one["x"])

    groups = LaneGroups(CALLS, 4)
    grouped, _ = groups.grouped(CALLS[0])
    jax.block_until_ready(jax.jit(groups.mapped(function))(lane(grouped, 2)))
    jax.effects_barrier()
    assert ran == [()]


def test_a_kind_that_was_not_announced_is_refused():
    with pytest.raises(ValueError, match="stacks must be of the kinds of the calls"):
        LaneGroups(CALLS[2:], 4).grouped([scalars(1)])
