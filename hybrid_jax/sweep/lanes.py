"""Map one function over many independent lanes: chunks of lanes under `vmap`, chunks in a loop, loops on all devices.

The devices are those of all processes of a run (see hosts.py): each hands its own lanes to its own devices, and all get
all results.

A lane is a slice of a pytree along its first axis. On a CPU a chunk of one lane is fastest, because one lane fills the
cache; on a GPU a chunk holds all lanes. Which lanes run is data, not shape: one compilation serves a sweep to its end.
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

from hybrid_jax.sweep import hosts

Numbers = Sequence[Any] | np.ndarray
AXIS = "lanes"
WIDTH = {"cpu": 1}  # measured by benchmarks/sweep.py; a backend that is not listed takes as many lanes as fit
USABLE = 0.8  # share of a device's free memory that a program may ask for; the rest is for what cannot be foreseen


def stack(lanes: Sequence[PyTree]) -> PyTree:
    """One tree whose arrays have a first axis over the lanes; leaves that are no arrays must agree."""
    return jax.tree.map(lambda *leaves: np.stack(leaves) if eqx.is_array_like(leaves[0]) else leaves[0], *lanes)


def lane(lanes: PyTree, index: int | np.ndarray) -> PyTree:
    """The lane, or lanes, at an index of the first axis."""
    # An entry of a NumPy vector is a scalar, which is no array: asarray makes it one again.
    return jax.tree.map(lambda leaf: np.asarray(leaf[index]) if eqx.is_array(leaf) else leaf, lanes)


def count(lanes: PyTree) -> int:
    """How many lanes there are."""
    return next(leaf.shape[0] for leaf in jax.tree.leaves(lanes) if eqx.is_array(leaf))


def deal(costs: Numbers, active: Numbers, devices: int, width: int, most: int) -> list[np.ndarray]:
    """For each device, which of the active lanes it runs and in which order; at most so many chunks.

    The dearest chunk goes first, to the device that has least to do; lanes of equal cost share a chunk, so that none of
    them waits long for another.
    """
    ordered = sorted(active, key=lambda i: -costs[i])
    chunks = [ordered[i : i + width] for i in range(0, len(ordered), width)]
    hands: list[list[int]] = [[] for _ in range(devices)]
    loads = [(0.0, device) for device in range(devices)]  # a heap of the devices that can take more
    for chunk in chunks:
        load, device = heapq.heappop(loads)
        hands[device] += chunk
        if len(hands[device]) < most * width:
            heapq.heappush(loads, (load + float(max(costs[i] for i in chunk)), device))
    return [np.array(hand, int) for hand in hands]


def slack(hands: Sequence[np.ndarray], costs: Numbers, width: int) -> Float[np.ndarray, " n"]:
    """For each lane that is dealt, the busiest device's work over its own device's; for the others 0."""
    # A chunk takes as long as its dearest lane, which is its first.
    loads = [sum(float(costs[i]) for i in hand[::width]) for hand in hands]
    ratios = np.zeros(len(costs))
    for hand, load in zip(hands, loads, strict=True):
        ratios[hand] = max(loads) / load if len(hand) else 0.0
    return ratios


class LaneMap:
    """`function(lane, *shared) -> lane's result`, compiled once for all lanes, chunks and devices.

    Args:
        function: from one lane and the shared arguments to a pytree of arrays.
        width: lanes in a chunk; by default what was measured for the backend; 0 for as many as fit into memory.
        devices: where chunks run, ordered by process; by default all devices of all processes.
        memory: bytes that a program may take on a device; by default most of what the device says is free.
        room: lanes that the program has places for, so that calls of fewer share it. Of no use where a chunk holds as
            many as fit: idle places of a chunk are computed.
        compiler: options of XLA.
    """

    def __init__(
        self,
        function: Callable[..., PyTree],
        width: int | None = None,
        devices: Any = None,
        memory: int | None = None,
        room: int = 0,
        compiler: dict[str, bool | int] | None = None,
    ):
        self.devices = sorted(jax.devices(), key=lambda d: d.process_index) if devices is None else list(devices)
        self.width = WIDTH.get(self.devices[0].platform, 0) if width is None else width
        self._memory, self._room = memory, room
        self._fitting: dict[int, int] = {}  # number of lanes → width
        self._mesh = Mesh(np.array(self.devices), (AXIS,))
        self._run = jax.jit(self._on_mesh(function), static_argnums=0, compiler_options=compiler)

    def __call__(self, lanes: PyTree, shared: tuple, costs: Numbers, active: Numbers) -> PyTree:
        """The results of the active lanes, in the order of `active`, as host arrays."""
        width = self._width(lanes, shared)
        hands, capacity = self._dealt(count(lanes), width, costs, active)
        places = np.stack([np.resize(np.concatenate([hand, [0]]), capacity) for hand in hands])
        chunks = np.array([-(-len(hand) // width) for hand in hands])
        own = [d for d, device in enumerate(self.devices) if device.process_index == jax.process_index()]
        results = self._launch(width, lane(lanes, places[own].ravel()), chunks[own], shared)
        where = {i: capacity * d + j for d, hand in enumerate(hands) for j, i in enumerate(hand)}
        return lane(results, np.array([where[i] for i in active], int))

    def slack(self, lanes: PyTree, shared: tuple, costs: Numbers, active: Numbers) -> Float[np.ndarray, " n"]:
        """For each active lane, how often its device could do all its work while the busiest does its own once."""
        width = self._width(lanes, shared)
        hands, _ = self._dealt(count(lanes), width, costs, active)
        return slack(hands, costs, width)[np.asarray(active, int)]

    def _dealt(self, total: int, width: int, costs: Numbers, active: Numbers) -> tuple[list[np.ndarray], int]:
        """What each device runs, and how many lanes it has room for."""
        most = self._most(total, width)
        return deal(costs, active, len(self.devices), width, most), most * width

    def _most(self, total: int, width: int) -> int:
        """Chunks that a device has room for: twice the even share, enough to balance costs, and all if it is alone."""
        places = max(total, self._room if self.width else 0)
        return min(-(-places // width), 2 * -(-places // (width * len(self.devices))))

    def _width(self, lanes: PyTree, shared: tuple) -> int:
        """The width that was asked for, or an even share of the lanes, halved until the program fits into memory."""
        total = count(lanes)
        if not self.width and total not in self._fitting:
            width = -(-total // len(self.devices))
            while width > 1 and self._needed(width, lanes, shared) > self._usable():
                width = -(-width // 2)
            self._fitting[total] = hosts.agreed(width)
        return self.width or self._fitting[total]

    def _needed(self, width: int, lanes: PyTree, shared: tuple) -> int:
        """Bytes of each device that the program for chunks of this width takes: asked of the compiler, nothing runs."""
        split, whole = NamedSharding(self._mesh, PartitionSpec(AXIS)), NamedSharding(self._mesh, PartitionSpec())
        places = len(self.devices) * self._most(count(lanes), width) * width

        def like(leaf, shape, sharding):
            return jax.ShapeDtypeStruct(shape, jax.dtypes.canonicalize_dtype(leaf.dtype), sharding=sharding)

        (lanes, shared), rest = eqx.partition((lanes, shared), eqx.is_array)
        lanes = jax.tree.map(lambda leaf: like(leaf, (places, *leaf.shape[1:]), split), lanes)
        shared = jax.tree.map(lambda leaf: like(leaf, leaf.shape, whole), shared)
        chunks = jax.ShapeDtypeStruct((len(self.devices),), jax.dtypes.canonicalize_dtype(int), sharding=split)
        found = self._run.lower(_Static(width, rest), lanes, chunks, shared).compile().memory_analysis()
        if found is None:  # a backend that cannot tell
            return 0
        return found.temp_size_in_bytes + found.argument_size_in_bytes + found.output_size_in_bytes

    def _usable(self) -> float:
        said = self.devices[0].memory_stats() if self._memory is None else None
        if said is None:  # a CPU does not say
            return float("inf") if self._memory is None else self._memory
        return USABLE * (said["bytes_limit"] - said["bytes_in_use"])

    def _launch(self, width: int, lanes: PyTree, chunks: Int[np.ndarray, " d"], shared: tuple) -> PyTree:
        """Results for the places of all devices; lanes and chunks are those of this process's devices."""
        split, whole = NamedSharding(self._mesh, PartitionSpec(AXIS)), NamedSharding(self._mesh, PartitionSpec())
        arrays, rest = eqx.partition((lanes, shared), eqx.is_array)
        lanes, shared = hosts.put(arrays[0], split), hosts.put(arrays[1], whole)
        return hosts.collect(self._run(_Static(width, rest), lanes, hosts.put(chunks, split), shared))

    def _on_mesh(self, function: Callable[..., PyTree]) -> Callable[..., PyTree]:
        split, whole = PartitionSpec(AXIS), PartitionSpec()

        def run(static, lanes, chunks, shared):
            def share(lanes, chunks, shared):
                whole_lanes, whole_shared = eqx.combine((lanes, shared), static.rest)
                return _loop(function, static.width, whole_lanes, chunks[0], whole_shared)

            mapped = jax.shard_map(
                share, mesh=self._mesh, in_specs=(split, split, whole), out_specs=split, check_vma=False
            )
            return mapped(lanes, chunks, shared)

        return run


class _Static:
    """What a compilation depends on beside shapes: the chunk's width and the leaves that are no arrays."""

    def __init__(self, width: int, rest: PyTree):
        self.width, self.rest = width, rest
        leaves, structure = jax.tree.flatten(rest)
        self._identity = (width, tuple(leaves), structure)

    def __hash__(self):
        return hash(self._identity)

    def __eq__(self, other):
        return self._identity == other._identity


def _loop(function, width: int, lanes: PyTree, chunks: Int[jax.Array, ""], shared: tuple) -> PyTree:
    """The results of the first `chunks` chunks of this device's lanes; the others' places hold zeros."""
    arrays, rest = eqx.partition(lanes, eqx.is_array)

    # Traced once, though it is asked for its shapes before it runs in the loop.
    @partial(jax.jit, inline=True)
    def one(arrays, shared):
        return eqx.filter(function(eqx.combine(arrays, rest), *shared), eqx.is_array)

    def chunk(arrays):
        if width > 1:
            return jax.vmap(one, in_axes=(0, None))(arrays, shared)
        # Without vmap a loop inside keeps a scalar condition and copies nothing that it does not change.
        return jax.tree.map(lambda leaf: leaf[None], one(jax.tree.map(lambda leaf: leaf[0], arrays), shared))

    def body(i, results):
        part = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, i * width, width), arrays)
        return jax.tree.map(
            lambda whole, new: jax.lax.dynamic_update_slice_in_dim(whole, new, i * width, 0), results, chunk(part)
        )

    shapes = jax.eval_shape(one, jax.tree.map(lambda leaf: leaf[0], arrays), shared)
    results = jax.tree.map(lambda s: jnp.zeros((count(lanes), *s.shape), s.dtype), shapes)
    return jax.lax.fori_loop(0, chunks, body, results)
