"""One run on many processes: who they are, what they tell each other, and how one that is gone is noticed.

All processes run the same program on the same numbers and call these functions in the same order. Lanes never talk to
each other (see lanes.py), so that all that travels are results, process 0's decisions, and what process 0 has read.
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

AXIS = "processes"
Arrays = Mapping[str, np.ndarray]


class PeerLost(ConnectionError):
    """Another process of this run has ended before its work was done."""


def initialize(coordinator: str | None = None, processes: int | None = None, process: int | None = None) -> None:
    """Become one of the processes of a run; call it before the first array is made.

    Args:
        coordinator: host:port of process 0. What is not given is taken from the cluster's variables, as far as
            `jax.distributed.initialize` knows them (Slurm, Open MPI, Kubernetes, Cloud TPU).

    Raises:
        ValueError: something is missing, does not fit together, or the processes differ in their number of devices.
        Gone: the other processes could not be reached.
    """
    jax.config.update("jax_enable_preemption_service", False)  # the host loop has its own ways to stop
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
        # The connections stand, and tell at once when one breaks. The coordination service would tell as well, but by
        # aborting the process, its results unsaved.
        jax.distributed.shutdown()


def is_main_process() -> bool:
    """Whether this is process 0, the one that reads, writes and reports; a process on its own is."""
    return jax.process_index() == 0


def put(tree: PyTree, sharding: Sharding) -> PyTree:
    """Arrays on the devices of all processes, of which each process hands over what its own devices hold."""
    if jax.process_count() == 1:
        return jax.device_put(tree, sharding)
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(sharding, np.asarray(leaf)), tree)


def collect(tree: PyTree) -> PyTree:
    """Arrays that are split along their first axis, in the order of the processes, as host arrays on each of them."""
    if jax.process_count() == 1:
        return jax.device_get(tree)

    def own(leaf: jax.Array) -> np.ndarray:
        shards = sorted(leaf.addressable_shards, key=lambda shard: shard.index[0].start or 0)
        return np.concatenate([np.asarray(shard.data) for shard in shards])

    return gather(jax.tree.map(own, tree))


def gather(tree: PyTree) -> PyTree:
    """Host arrays of all processes, put together along the first axis; shapes must agree.

    Raises:
        Gone: another process has ended.
    """
    leaves, structure = jax.tree.flatten(tree)
    # As one array of bytes: an exchange costs milliseconds, however little travels, and JAX would cut 64 bits to 32.
    lines = [np.ascontiguousarray(leaf).ravel().view(np.uint8) for leaf in leaves]
    whole = _exchange(_side_by_side, np.concatenate(lines)[None])
    parts = np.split(whole, np.cumsum([len(line) for line in lines])[:-1], axis=1)
    return structure.unflatten(
        np.ascontiguousarray(part).view(leaf.dtype).reshape(-1, *leaf.shape[1:])
        for part, leaf in zip(parts, leaves, strict=True)
    )


def agreed(number: int) -> int:
    """Process 0's number; the others' are ignored.

    Raises:
        Gone: another process has ended.
    """
    return int(gather(np.array([number]))[0]) if jax.process_count() > 1 else number


def from_first(make: Callable[[], tuple[Any, Arrays]]) -> tuple[Any, Arrays]:
    """What `make` gives on process 0, JSON values and named arrays; on the others it is not called.

    Raises:
        Gone: another process has ended: process 0, if `make` failed there.
    """
    if jax.process_count() == 1:
        return make()
    message = np.frombuffer(_pack(*make()), np.uint8) if is_main_process() else np.zeros(0, np.uint8)
    size = agreed(len(message))
    return _unpack(_exchange(_sum, (message if is_main_process() else np.zeros(size, np.uint8))[None])[0])


def _pack(about: Any, arrays: Arrays) -> bytes:
    buffer = io.BytesIO()
    words = np.frombuffer(json.dumps(about).encode(), np.uint8)
    np.savez(buffer, allow_pickle=False, about=words, **{f"/{name}": array for name, array in arrays.items()})
    return buffer.getvalue()


def _unpack(message: np.ndarray) -> tuple[Any, Arrays]:
    with np.load(io.BytesIO(message.tobytes()), allow_pickle=False) as entries:
        arrays = {name[1:]: entries[name] for name in entries.files if name != "about"}
        return json.loads(entries["about"].tobytes()), arrays


@cache
def _mesh() -> Mesh:
    """One device of each process: what hosts exchange needs no more, and one mesh is one set of connections."""
    leaders = {device.process_index: device for device in reversed(jax.devices())}
    return Mesh(np.array([leaders[process] for process in sorted(leaders)]), (AXIS,))


def _exchange(how: Callable[[jax.Array], jax.Array], own: np.ndarray) -> np.ndarray:
    """What a compiled function makes of the arrays of all processes, as a host array on each of them."""
    split, whole = NamedSharding(_mesh(), PartitionSpec(AXIS)), NamedSharding(_mesh(), PartitionSpec())
    with _noticing():
        return np.asarray(_compiled(how, whole)(put(own, split)).addressable_data(0))


@cache
def _compiled(how: Callable[[jax.Array], jax.Array], whole: Sharding) -> Callable[[jax.Array], jax.Array]:
    return jax.jit(how, out_shardings=whole)


def _side_by_side(parts: jax.Array) -> jax.Array:
    return parts


def _sum(parts: jax.Array) -> jax.Array:
    return jnp.sum(parts, axis=0, keepdims=True, dtype=parts.dtype)


@contextlib.contextmanager
def _noticing() -> Iterator[None]:
    """Turn what the runtime says of a broken connection into one line."""
    try:
        yield
    except (RuntimeError, ValueError) as error:  # of the launch, or of a result that never came
        raise PeerLost(
            "another process of this run has ended; the same command goes on from what process 0 has saved, with any "
            f"number of processes ({str(error).splitlines()[0]})"
        ) from error
