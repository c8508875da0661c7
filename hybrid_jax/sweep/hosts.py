"""Several processes: initialisation, gathering results on every process, and detection of lost peers.

All processes run the same program on the same data and call these functions in the same order. Only results, and what
process 0 decides or reads, travel between them. Every function that communicates raises PeerLost when another process
has ended.
"""

import contextlib
import io
import json
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding
from jaxtyping import PyTree

Arrays = Mapping[str, np.ndarray]
AXIS = "processes"


class PeerLost(ConnectionError):
    """Another process of this run has ended before its work was done."""


def initialize(coordinator: str | None = None, processes: int | None = None, process: int | None = None) -> None:
    """Join a multi-process run, whose process 0 is at `coordinator`, host:port. Call it before the first array is made.

    Missing arguments are detected by `jax.distributed.initialize` (Slurm, Open MPI, Kubernetes, Cloud TPU).

    Raises:
        ValueError: an argument is missing or inconsistent, or the processes differ in their number of devices.
    """
    jax.config.update("jax_enable_preemption_service", False)  # the host loop handles signals
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except ValueError as error:
        raise ValueError(f"--distributed: {error}") from error
    except RuntimeError as error:
        raise PeerLost(f"the processes did not find each other: {error}") from error
    devices = gather(np.array([jax.local_device_count()]))
    if len(set(devices.tolist())) > 1:
        raise ValueError(f"all processes must have the same number of devices, got {devices.tolist()}")
    if jax.default_backend() == "cpu":
        # Open connections report a lost peer. The coordination service would abort this process before it can save.
        jax.distributed.shutdown()


def is_main_process() -> bool:
    """Whether this is process 0, the only one that reads, writes and prints."""
    return jax.process_index() == 0


def put(tree: PyTree, sharding: Sharding) -> PyTree:
    """Global arrays; each process passes the part that its own devices hold."""
    if jax.process_count() == 1:
        return jax.device_put(tree, sharding)
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(sharding, np.asarray(leaf)), tree)


def collect(tree: PyTree) -> PyTree:
    """Global arrays, split along their first axis, as host arrays on every process."""
    if jax.process_count() == 1:
        return jax.device_get(tree)

    def own(leaf: jax.Array) -> np.ndarray:
        shards = sorted(leaf.addressable_shards, key=lambda shard: shard.index[0].start or 0)
        return np.concatenate([np.asarray(shard.data) for shard in shards])

    return gather(jax.tree.map(own, tree))


def gather(tree: PyTree) -> PyTree:
    """Host arrays of all processes, concatenated along the first axis on every process; shapes must agree."""
    leaves, structure = jax.tree.flatten(tree)
    # As one array of bytes: an exchange takes milliseconds whatever its size, and JAX would truncate 64-bit numbers.
    rows = [np.ascontiguousarray(leaf).ravel().view(np.uint8) for leaf in leaves]
    found = _exchange(_identity, np.concatenate(rows)[None])
    parts = np.split(found, np.cumsum([len(row) for row in rows])[:-1], axis=1)
    return structure.unflatten(
        np.ascontiguousarray(part).view(leaf.dtype).reshape(-1, *leaf.shape[1:])
        for part, leaf in zip(parts, leaves, strict=True)
    )


def agreed(number: int) -> int:
    """Process 0's number, on every process."""
    return int(gather(np.array([number]))[0]) if jax.process_count() > 1 else number


def from_first(make: Callable[[], tuple[Any, Arrays]]) -> tuple[Any, Arrays]:
    """The result of `make` on process 0, JSON values and named arrays, on every process; only process 0 calls it."""
    if jax.process_count() == 1:
        return make()
    message = np.frombuffer(_pack(*make()), np.uint8) if is_main_process() else np.zeros(0, np.uint8)
    size = agreed(len(message))
    return _unpack(_exchange(_sum, (message if is_main_process() else np.zeros(size, np.uint8))[None])[0])


def _pack(about: Any, arrays: Arrays) -> bytes:
    buffer = io.BytesIO()
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    np.savez(buffer, allow_pickle=False, about=text, **{f"/{name}": array for name, array in arrays.items()})
    return buffer.getvalue()


def _unpack(message: np.ndarray) -> tuple[Any, Arrays]:
    with np.load(io.BytesIO(message.tobytes()), allow_pickle=False) as entries:
        arrays = {name[1:]: entries[name] for name in entries.files if name != "about"}
        return json.loads(entries["about"].tobytes()), arrays


@cache
def _mesh() -> Mesh:
    """One device of each process. One mesh is one set of connections, which are made before the service shuts down."""
    leaders = {device.process_index: device for device in reversed(jax.devices())}
    return Mesh(np.array([leaders[process] for process in sorted(leaders)]), (AXIS,))


def _exchange(function: Callable[[jax.Array], jax.Array], own: np.ndarray) -> np.ndarray:
    """A compiled function of the arrays of all processes, as a host array on each of them."""
    split, whole = NamedSharding(_mesh(), PartitionSpec(AXIS)), NamedSharding(_mesh(), PartitionSpec())
    with _detect_lost_peers():
        return np.asarray(_compiled(function, whole)(put(own, split)).addressable_data(0))


@cache
def _compiled(function: Callable[[jax.Array], jax.Array], whole: Sharding) -> Callable[[jax.Array], jax.Array]:
    return jax.jit(function, out_shardings=whole)


def _identity(parts: jax.Array) -> jax.Array:
    return parts


def _sum(parts: jax.Array) -> jax.Array:
    return jnp.sum(parts, axis=0, keepdims=True, dtype=parts.dtype)


@contextlib.contextmanager
def _detect_lost_peers() -> Iterator[None]:
    """Turn the runtime's errors about a broken connection into one line."""
    try:
        yield
    except (RuntimeError, ValueError) as error:  # of the launch, or of a result that never arrived
        raise PeerLost(
            "another process of this run has ended; the same command goes on from what process 0 has saved, with any "
            f"number of processes ({str(error).splitlines()[0]})"
        ) from error
