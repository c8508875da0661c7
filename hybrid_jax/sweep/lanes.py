"""Map one function over many independent lanes: chunks of lanes under `vmap`, chunks in a loop, loops on all devices.

A lane is a slice of a pytree along its first axis. Which lanes are active is data, so that a sweep compiles once.
"""

import heapq
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float, Int, PyTree

from hybrid_jax.runtime import jit_with
from hybrid_jax.sweep import hosts

Numbers = Sequence[Any] | np.ndarray
AXIS = "lanes"
WIDTH = {"cpu": 1}  # one lane fills the cache; on a GPU, a chunk contains all lanes of a device


def stack(lanes: Sequence[PyTree]) -> PyTree:
    """Stack trees along a new first axis over the lanes; ValueError if other leaves, for example floats, differ.

    Args:
        lanes: one tree for each lane, all of the same structure.
    """

    def stacked(*leaves):
        if isinstance(leaves[0], jax.Array | np.ndarray | np.generic):
            return np.stack(leaves)
        if any(leaf != leaves[0] for leaf in leaves):
            raise ValueError(f"lanes: {leaves[0]!r} must be an array if it differs between lanes")
        return leaves[0]

    return jax.tree.map(stacked, *lanes)


def lane(lanes: PyTree, index: int | np.ndarray) -> PyTree:
    """Return the lane, or the lanes, at an index of the first axis.

    Args:
        lanes: a tree whose arrays have a first axis over the lanes.
        index: the number of a lane, from 0, or an array of indices or booleans.
    """
    # An entry of a NumPy vector is a scalar, hence asarray.
    return jax.tree.map(lambda leaf: np.asarray(leaf[index]) if eqx.is_array(leaf) else leaf, lanes)


def count(lanes: PyTree) -> int:
    return next(leaf.shape[0] for leaf in jax.tree.leaves(lanes) if eqx.is_array(leaf))


def schedule(costs: Numbers, active: Numbers, devices: int, width: int, capacity: int) -> list[np.ndarray]:
    """Return the active lanes of each device, the most expensive chunk first, in at most `capacity` chunks."""
    ordered = sorted(active, key=lambda i: -costs[i])  # no lane of a chunk waits long for another
    shards: list[list[int]] = [[] for _ in range(devices)]
    loads = [(0.0, device) for device in range(devices)]  # a heap of the devices that can take more
    for chunk in (ordered[i : i + width] for i in range(0, len(ordered), width)):
        load, device = heapq.heappop(loads)
        shards[device] += chunk
        if len(shards[device]) < capacity * width:
            heapq.heappush(loads, (load + float(max(costs[i] for i in chunk)), device))
    return [np.array(shard, int) for shard in shards]


def load_balance(shards: Sequence[np.ndarray], costs: Numbers, width: int) -> Float[np.ndarray, " n"]:
    """Return for each lane the work of the busiest device over the work of its own; 0 if it is not scheduled."""
    # A chunk takes as long as its most expensive lane, which is its first.
    loads, ratios = [sum(float(costs[i]) for i in shard[::width]) for shard in shards], np.zeros(len(costs))
    for shard, load in zip(shards, loads, strict=True):
        ratios[shard] = max(loads) / load if len(shard) else 0.0
    return ratios


class LaneMap:
    """`function(lane, *shared) -> pytree of arrays`, compiled once for all lanes, chunks and devices.

    Args:
        width: lanes in a chunk. Default: 1 on a CPU; elsewhere 0, an even share of the lanes for each device.
        min_capacity: the smallest number of lanes to compile for, so that smaller calls share the program. Ignored if
            the width is 0.
        compiler: options of XLA.
    """

    def __init__(
        self,
        function: Callable,
        width: int | None = None,
        min_capacity: int = 0,
        compiler: dict[str, bool | int] | None = None,
    ):
        self.devices = sorted(jax.devices(), key=lambda d: d.process_index)
        self.width = WIDTH.get(self.devices[0].platform, 0) if width is None else width
        self._min_capacity = min_capacity
        mesh = Mesh(np.array(self.devices), (AXIS,))
        self._split, self._whole = NamedSharding(mesh, PartitionSpec(AXIS)), NamedSharding(mesh, PartitionSpec())
        self._function, self._run = function, jit_with(compiler)(_on_mesh)

    def __call__(self, lanes: PyTree, shared: tuple, costs: Numbers, active: Numbers) -> PyTree:
        """Return the results of the active lanes, in the order of `active`, as host arrays."""
        shards, width, capacity = self.schedule(count(lanes), costs, active)
        places = np.stack([np.resize(np.concatenate([shard, [0]]), capacity * width) for shard in shards])
        chunks = np.array([-(-len(shard) // width) for shard in shards])
        own = [d for d, device in enumerate(self.devices) if device.process_index == jax.process_index()]
        arrays, rest = eqx.partition((lane(lanes, places[own].ravel()), shared), eqx.is_array)
        put_lanes, put_shared = hosts.put(arrays[0], self._split), hosts.put(arrays[1], self._whole)
        put = put_lanes, hosts.put(chunks[own], self._split), put_shared
        results = hosts.collect(self._run(self._function, width, tuple(self.devices), rest, *put))
        where = {i: capacity * width * d + j for d, shard in enumerate(shards) for j, i in enumerate(shard)}
        return lane(results, np.array([where[i] for i in active], int))

    def schedule(self, total: int, costs: Numbers, active: Numbers) -> tuple[list[np.ndarray], int, int]:
        """Return each device's shard, the width of a chunk, and the number of chunks of a device.

        Args:
            total: the number of lanes.
            costs: the expected work of each lane, in any unit.
            active: indices of the active lanes.
        """
        devices = len(self.devices)
        width = self.width or -(-total // devices)
        lanes = max(total, self._min_capacity if self.width else 0)
        # Twice the even share is enough to balance costs.
        capacity = min(-(-lanes // width), 2 * -(-lanes // (width * devices)))
        return schedule(costs, active, devices, width, capacity), width, capacity


def _on_mesh(function: Callable, width: int, devices: tuple, rest: PyTree, lanes, chunks, shared) -> PyTree:
    """Return the results of each device's lanes on this device; `rest` contains the leaves that are not arrays."""
    mesh, split, whole = Mesh(np.array(devices), (AXIS,)), PartitionSpec(AXIS), PartitionSpec()

    def share(lanes, chunks, shared):
        lanes, shared = eqx.combine((lanes, shared), rest)
        return _loop(function, width, lanes, chunks[0], shared)

    mapped = jax.shard_map(share, mesh=mesh, in_specs=(split, split, whole), out_specs=split, check_vma=False)
    return mapped(lanes, chunks, shared)


def _loop(function, width: int, lanes: PyTree, chunks: Int[jax.Array, ""], shared: tuple) -> PyTree:
    """Return the results of the first `chunks` chunks of this device's lanes, padded with zeros."""
    arrays, rest = eqx.partition(lanes, eqx.is_array)

    # With jit it is traced only once, although eval_shape needs it too.
    @partial(jax.jit, inline=True)
    def one(arrays, shared):
        return eqx.filter(function(eqx.combine(arrays, rest), *shared), eqx.is_array)

    def chunk(arrays):
        if width > 1:
            return jax.vmap(one, in_axes=(0, None))(arrays, shared)
        # Without vmap an inner loop keeps a scalar condition and does not copy what it leaves unchanged.
        return jax.tree.map(lambda leaf: leaf[None], one(jax.tree.map(lambda leaf: leaf[0], arrays), shared))

    def body(i, results):
        part = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, i * width, width), arrays)
        put = partial(jax.lax.dynamic_update_slice_in_dim, start_index=i * width, axis=0)
        return jax.tree.map(put, results, chunk(part))

    shapes = jax.eval_shape(one, jax.tree.map(lambda leaf: leaf[0], arrays), shared)
    results = jax.tree.map(lambda s: jnp.zeros((count(lanes), *s.shape), s.dtype), shapes)
    return jax.lax.fori_loop(0, chunks, body, results)
