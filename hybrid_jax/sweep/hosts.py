"""Multi-process runs: initialisation, and results on every process.

All processes run the same program on the same data and call these functions in the same order. Only results, and the
decisions and files of process 0, are exchanged. Every function that communicates raises PeerLost if another process is
lost; you can then run the same command again, with any number of processes, to continue from what process 0 has saved.
"""

import io
import json
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Sharding
from jaxtyping import PyTree

from hybrid_jax.sweep.peers import PeerLost, Peers

Arrays = Mapping[str, np.ndarray]
_known: list[Peers] = []  # of this run, where the coordinator was given


def initialize(
    coordinator: str | None = None,
    processes: int | None = None,
    process: int | None = None,
    alike: Mapping[str, Any] | None = None,
    timeout: float = 120.0,
) -> None:
    """Join a multi-process run. Call this before you create the first array.

    Missing arguments are detected by `jax.distributed.initialize` (Slurm, Open MPI, Kubernetes, Cloud TPU); there the
    cluster monitors the processes instead of `timeout`.

    Args:
        coordinator: host:port of process 0.
        processes: the number of processes.
        process: the index of this one, from 0.
        alike: JSON values by name that must agree between all processes, e.g. options and a digest of the source.
        timeout: seconds after which a process that does not join or answer counts as lost.

    Raises:
        ValueError: an argument is missing or inconsistent, or the processes differ in `alike`.
        PeerLost: another process did not join.
    """
    jax.config.update("jax_enable_preemption_service", False)  # the host loop handles signals
    try:
        if coordinator and processes and process is not None and 0 <= process < processes:
            _known[:] = [Peers(coordinator, processes, process, timeout)]
        jax.distributed.initialize(coordinator, processes, process)
    except (ValueError, OSError) as error:
        if isinstance(error, PeerLost):
            raise
        raise ValueError(f"coordinator, processes, process: {error}") from error
    except RuntimeError as error:
        raise PeerLost(f"the processes could not connect: {error}") from error
    # XLA's connections are made here; afterwards the service that arranges them is not needed.
    _require_alike({"devices": jax.local_device_count()} | dict(alike or {}))
    if jax.default_backend() == "cpu":
        # The coordination service would abort this process before it can save; `Peers` reports a lost one.
        jax.distributed.shutdown()


def _require_alike(values: Mapping[str, Any]) -> None:
    own = json.loads(json.dumps(values, default=str))
    first, _ = from_first(lambda: (own, {}))
    names = sorted(name for name in own.keys() | first.keys() if own.get(name) != first.get(name))
    others = np.flatnonzero(gather(np.array([len(names)]))).tolist()
    if names:
        raise ValueError(f"processes of one run must be started alike, this one differs from 0 in {', '.join(names)}")
    if others:
        raise ValueError(f"processes of one run must be started alike, {others} differ from this one")


def is_main_process() -> bool:
    """Whether this is process 0, the only one that reads, writes and prints."""
    return jax.process_index() == 0


def put(tree: PyTree, sharding: Sharding) -> PyTree:
    """Global arrays; each process provides the part on its own devices."""
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
    found = _exchange(lambda: multihost_utils.process_allgather(np.concatenate(rows)))
    parts = np.split(found, np.cumsum([len(row) for row in rows])[:-1], axis=1)
    return structure.unflatten(
        np.ascontiguousarray(part).view(leaf.dtype).reshape(-1, *leaf.shape[1:])
        for part, leaf in zip(parts, leaves, strict=True)
    )


def agreed(number: int) -> int:
    """Process 0's number, on every process."""
    return int(gather(np.array([number]))[0]) if jax.process_count() > 1 else number


def from_first(make: Callable[[], tuple[Any, Arrays]]) -> tuple[Any, Arrays]:
    """The result of `make`, JSON values and named arrays, which only process 0 calls, on every process."""
    if jax.process_count() == 1:
        return make()
    message = np.frombuffer(_pack(*make()), np.uint8) if is_main_process() else np.zeros(0, np.uint8)
    message = np.resize(message, agreed(len(message)))  # of the same shape everywhere; only that of process 0 counts
    return _unpack(_exchange(lambda: multihost_utils.broadcast_one_to_all(message)))


def _pack(about: Any, arrays: Arrays) -> bytes:
    buffer = io.BytesIO()
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    np.savez(buffer, allow_pickle=False, about=text, **{f"/{name}": array for name, array in arrays.items()})
    return buffer.getvalue()


def _unpack(message: np.ndarray) -> tuple[Any, Arrays]:
    with np.load(io.BytesIO(message.tobytes()), allow_pickle=False) as entries:
        arrays = {name[1:]: entries[name] for name in entries.files if name != "about"}
        return json.loads(entries["about"].tobytes()), arrays


def _exchange(call: Callable[[], Any]) -> Any:
    """The result of a call that waits for all processes, or PeerLost."""
    try:
        return _known[0].waited_for(call) if _known else call()
    except (RuntimeError, ValueError) as error:  # of the launch, or of a result that never arrived
        raise PeerLost(f"another process of this run has ended ({str(error).splitlines()[0]})") from error
