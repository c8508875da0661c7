"""Multi-process runs: initialisation, heartbeats, and results on every process.

All processes run the same program on the same data and call these functions in the same order. They exchange results,
and the decisions and files of process 0. Every function that communicates raises PeerLost if another process is lost;
you can then run the same command again, with any number of processes, to continue from what process 0 has saved.
"""

import atexit
import io
import json
import os
import select
import socket
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Sharding
from jaxtyping import PyTree

BEAT = 1.0  # s between two heartbeats
GRACE = 3.0  # s in which messages sent before a loss, or the news of it, may still arrive

Arrays = Mapping[str, np.ndarray]


class PeerLost(ConnectionError):
    """Another process of this run has ended, does not answer, or never joined."""


class Peers:
    """Heartbeats between process 0 and all others; process 0 announces who is lost.

    JAX itself aborts if a peer does not join, and waits forever for a stopped one.
    """

    def __init__(self, coordinator: str, processes: int, process: int, timeout: float):
        host, _, port = coordinator.rpartition(":")
        self.lost = ""  # which process is lost and how, if any
        self._timeout, until = timeout, time.monotonic() + timeout
        self._links = self._join(host, int(port), process) if process else self._gather(int(port), processes, until)
        self._heard = dict.fromkeys(self._links, time.monotonic())
        threading.Thread(target=self._listen, daemon=True).start()

    def _gather(self, port: int, processes: int, until: float) -> dict[int, socket.socket]:
        """Return links to all others; if some do not join, raise PeerLost with their names on every process."""
        links: dict[int, socket.socket] = {}
        with socket.create_server(("", port)) as door:
            while len(links) < processes - 1 and select.select([door], [], [], max(0.0, until - time.monotonic()))[0]:
                link = door.accept()[0]
                link.settimeout(BEAT)
                try:
                    links[int(link.recv(20))] = link
                except (OSError, ValueError):  # not of this run
                    link.close()
        absent = [number for number in range(1, processes) if number not in links]
        news = f"process {', '.join(map(str, absent))} did not join within {self._timeout:g} s" if absent else ""
        for link in links.values():
            link.sendall(f"{news}\n".encode())
        if news:
            raise PeerLost(news)
        return links

    def _join(self, host: str, port: int, process: int) -> dict[int, socket.socket]:
        until = time.monotonic() + self._timeout
        while time.monotonic() < until:
            try:
                link = socket.create_connection((host, port), BEAT)
                link.sendall(str(process).encode())
                link.settimeout(self._timeout + 2 * BEAT)  # process 0 may have come later
                if news := link.makefile().readline():
                    if news.strip():
                        raise PeerLost(news.strip())
                    return {0: link}
            except PeerLost:
                raise
            except OSError:
                time.sleep(BEAT / 5)
        raise PeerLost(f"process 0 at {host}:{port} did not join within {self._timeout:g} s")

    def _listen(self) -> None:
        next_beat = 0.0
        while not self.lost:
            if (now := time.monotonic()) >= next_beat:
                self._send(b"\n")
                next_beat = now + BEAT
            for link in select.select(list(self._links.values()), [], [], BEAT / 5)[0]:
                number = next(number for number, each in self._links.items() if each is link)
                try:
                    said = link.recv(1000)
                except OSError:
                    said = b""
                self._heard[number] = time.monotonic()
                self.lost = self.lost or (said.decode().strip() if said else f"process {number} has ended")
            for number, heard in self._heard.items():
                if time.monotonic() - heard > self._timeout and not self.lost:
                    self.lost = f"process {number} has not answered for {self._timeout:g} s"
        self._send(f"{self.lost}\n".encode())

    def _send(self, words: bytes) -> None:
        for link in self._links.values():
            try:
                link.sendall(words)
            except OSError:  # the next `recv` finds who is lost
                continue

    def waited_for(self, exchange: Callable[[], Any]) -> Any:
        """Return the result of a call that waits for all others; raise PeerLost as soon as one of them is lost."""
        found, done = dict[str, Any](), threading.Event()

        def run() -> None:
            try:
                found["result"] = exchange()
            except Exception as error:
                found["error"] = error
            done.set()

        threading.Thread(target=run, daemon=True).start()
        while not done.wait(BEAT / 5):
            if self.lost and not done.wait(GRACE):
                atexit.register(os._exit, 2)  # the waiting call would keep the process alive
                raise PeerLost(self.lost)
        if "error" in found:
            until = time.monotonic() + GRACE
            while not self.lost and time.monotonic() < until:
                time.sleep(BEAT / 10)
            raise PeerLost(self.lost or str(found["error"]).splitlines()[0]) from found["error"]
        return found["result"]


_known: list[Peers] = []  # of this run, if the coordinator was given


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
        alike: JSON values by name that must agree between all processes, for example options.
        timeout: seconds after which a process that does not join or answer counts as lost.

    Raises:
        ValueError: if an argument is missing or inconsistent, or the processes differ in `alike`.
        PeerLost: if another process did not join.
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
    # This call makes XLA's connections; the coordination service is not needed afterwards.
    _require_alike({"devices": jax.local_device_count()} | dict(alike or {}))
    if jax.default_backend() == "cpu":
        # The service would abort this process before it can save; `Peers` reports lost processes instead.
        jax.distributed.shutdown()


def _require_alike(values: Mapping[str, Any]) -> None:
    own = json.loads(json.dumps(values, default=str))
    first, _ = from_first(lambda: (own, {}))
    names = sorted(name for name in own.keys() | first.keys() if own.get(name) != first.get(name))
    others = np.flatnonzero(gather(np.array([len(names)]))).tolist()
    if names:
        raise ValueError(f"all processes must be started alike, but this one differs from 0 in {', '.join(names)}")
    if others:
        raise ValueError(f"all processes must be started alike, but {others} differ from this one")


def is_main_process() -> bool:
    """Return whether this is process 0, the only one that reads, writes and prints."""
    return jax.process_index() == 0


def put(tree: PyTree, sharding: Sharding) -> PyTree:
    """Return global arrays; each process provides the part on its own devices."""
    if jax.process_count() == 1:
        return jax.device_put(tree, sharding)
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(sharding, np.asarray(leaf)), tree)


def collect(tree: PyTree) -> PyTree:
    """Return global arrays, split along their first axis, as host arrays on every process."""
    if jax.process_count() == 1:
        return jax.device_get(tree)

    def own(leaf: jax.Array) -> np.ndarray:
        shards = sorted(leaf.addressable_shards, key=lambda shard: shard.index[0].start or 0)
        return np.concatenate([np.asarray(shard.data) for shard in shards])

    return gather(jax.tree.map(own, tree))


def gather(tree: PyTree) -> PyTree:
    """Concatenate host arrays of all processes along the first axis, on every process; shapes must agree."""
    leaves, structure = jax.tree.flatten(tree)
    # As one array of bytes: each exchange takes milliseconds at any size, and JAX would truncate 64-bit numbers.
    rows = [np.ascontiguousarray(leaf).ravel().view(np.uint8) for leaf in leaves]
    found = _exchange(lambda: multihost_utils.process_allgather(np.concatenate(rows)))
    both = zip(np.split(found, np.cumsum([len(row) for row in rows])[:-1], axis=1), leaves, strict=True)
    return structure.unflatten(np.ascontiguousarray(a).view(b.dtype).reshape(-1, *b.shape[1:]) for a, b in both)


def agreed(number: int) -> int:
    """Return process 0's number on every process."""
    return int(gather(np.array([number]))[0]) if jax.process_count() > 1 else number


def from_first(make: Callable[[], tuple[Any, Arrays]]) -> tuple[Any, Arrays]:
    """Call `make` on process 0, and return its result, JSON values and named arrays, on every process."""
    if jax.process_count() == 1:
        return make()
    message = np.frombuffer(_pack(*make()), np.uint8) if is_main_process() else np.zeros(0, np.uint8)
    message = np.resize(message, agreed(len(message)))  # the same shape everywhere
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
    """Return the result of a call that waits for all processes; raise PeerLost if one is lost."""
    try:
        return _known[0].waited_for(call) if _known else call()
    except (RuntimeError, ValueError) as error:  # of the launch, or of a result that never arrived
        raise PeerLost(f"another process of this run has ended ({str(error).splitlines()[0]})") from error
