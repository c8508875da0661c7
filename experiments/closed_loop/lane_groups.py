"""Lanes of several kinds in one compiled program: it branches by groups of lanes of one kind.

Lanes are of one kind if they can be stacked: the same structure, shapes and precision. `jax.vmap` maps over one kind
only, and a lane that is padded to the shape of another, or computes what only another needs, pays for it. The kind of a
group that is mapped as one lane is a scalar, so `jax.lax.switch` takes one branch and computes nothing else.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial, reduce
from operator import or_

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, PyTree

from hybrid_jax.sweep.lanes import count, lane, stack


class Group(eqx.Module):
    """Lanes of one kind.

    Attributes:
        kind: which.
        members: for each kind as many lanes as a group of it has; zeros but for the group's own.
    """

    kind: Int[jax.Array, ""]
    members: tuple[PyTree, ...]


def kind(lanes: PyTree) -> tuple:
    """What stacked lanes must have in common to be stacked with others."""
    return jax.tree.structure(lanes), *((leaf.shape[1:], leaf.dtype) for leaf in jax.tree.leaves(lanes))


class LaneGroups:
    """How lanes are grouped, so that all calls share a program.

    Args:
        calls: for each call of the program its lanes: stacks of them, each of one kind.
        width: lanes in a group; fewer of a kind of which no call has as many.

    Attributes:
        room: groups of the largest call.
    """

    def __init__(self, calls: Sequence[Sequence[PyTree]], width: int):
        tallies = [_tally(stacks) for stacks in calls]
        most = reduce(or_, tallies)
        self._widths = {own: min(width, n) for own, n in most.items()}
        self._width = max(self._widths.values())
        self.room = max(sum(-(-n // self._widths[own]) for own, n in tally.items()) for tally in tallies)
        examples = {kind(lanes): lanes for stacks in calls for lanes in stacks}
        self._blank = tuple(jax.tree.map(np.zeros_like, self._taken(examples[own], [0])) for own in self._widths)

    def grouped(self, stacks: Sequence[PyTree]) -> tuple[Group, Int[np.ndarray, "n 2"]]:
        """The groups of a call, stacked, and where each lane, in the order of the stacks, is: group and place in it.

        Raises:
            ValueError: lanes of a kind that no call was said to have.
        """
        kinds = list(map(self._number, stacks))
        of_lane = np.repeat(kinds, list(map(count, stacks)))
        groups, where = [], np.zeros((len(of_lane), 2), int)
        for number in sorted(set(kinds)):
            alike = [lanes for lanes, other in zip(stacks, kinds, strict=True) if other == number]
            lanes = jax.tree.map(lambda *leaves: np.concatenate(leaves), *alike)
            places, width = np.flatnonzero(of_lane == number), self._widths[kind(lanes)]
            for first in range(0, len(places), width):
                chosen = np.arange(first, min(first + width, len(places)))
                where[places[chosen], 0], where[places[chosen], 1] = len(groups), chosen - first
                groups.append(self._group(number, self._taken(lanes, chosen)))
        return stack(groups), where

    def costs(self, groups: Group) -> Int[np.ndarray, " n"]:
        """What each group costs: as many lanes as are computed."""
        return np.array(list(self._widths.values()))[np.asarray(groups.kind)]

    def mapped(self, function: Callable[..., PyTree]) -> Callable[..., PyTree]:
        """`function(group, *shared)`: the results of its lanes, stacked to the width of the widest group."""

        def results(members: PyTree, shared: tuple) -> PyTree:
            if count(members) > 1:
                found = jax.vmap(lambda lane: function(lane, *shared))(members)
            else:  # without vmap a loop inside keeps a scalar condition
                alone = function(jax.tree.map(lambda leaf: leaf[0], members), *shared)
                found = jax.tree.map(lambda leaf: leaf[None], alone)
            return jax.tree.map(self._filled, found)

        def of_group(group: Group, *shared) -> PyTree:
            return jax.lax.switch(group.kind, [partial(results, members, shared) for members in group.members])

        return of_group

    def _number(self, lanes: PyTree) -> int:
        """Which kind they are of."""
        if kind(lanes) not in self._widths:
            raise ValueError("stacks must be of the kinds of the calls that were given, got lanes of another one")
        return list(self._widths).index(kind(lanes))

    def _group(self, number: int, lanes: PyTree) -> Group:
        members = (lanes if i == number else blank for i, blank in enumerate(self._blank))
        return Group(jnp.asarray(number), tuple(members))

    def _taken(self, lanes: PyTree, chosen) -> PyTree:
        """These lanes, and the same again for places that are left."""
        return lane(lanes, np.resize(chosen, self._widths[kind(lanes)]))

    def _filled(self, leaf: jax.Array) -> jax.Array:
        return jnp.pad(leaf, [(0, self._width - len(leaf)), *[(0, 0)] * (leaf.ndim - 1)])


def _tally(stacks: Sequence[PyTree]) -> Counter[tuple]:
    """How many lanes there are of each kind."""
    return sum((Counter({kind(lanes): count(lanes)}) for lanes in stacks), Counter())
