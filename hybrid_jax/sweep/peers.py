"""Monitor a multi-process run: processes connect before JAX starts, then exchange heartbeats every second."""

import atexit
import os
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

BEAT = 1.0  # s between two signs of life
GRACE = 3.0  # s that what was sent before a loss may still take to arrive, or the news of who was lost


class PeerLost(ConnectionError):
    """Another process of this run has ended, does not answer, or never joined."""


class Peers:
    """Heartbeats between process 0 and all others; process 0 announces who is lost.

    JAX itself aborts if a peer does not join, and waits forever for one that was stopped.
    """

    def __init__(self, coordinator: str, processes: int, process: int, timeout: float):
        host, _, port = coordinator.rpartition(":")
        self.lost = ""  # which process is lost and how, once there is one
        self._timeout, until = timeout, time.monotonic() + timeout
        self._links = (
            self._gather(int(port), processes, until) if process == 0 else self._join(host, int(port), process)
        )
        self._heard = dict.fromkeys(self._links, time.monotonic())
        threading.Thread(target=self._listen, daemon=True).start()

    def _gather(self, port: int, processes: int, until: float) -> dict[int, socket.socket]:
        """The links to all others; PeerLost, on every process that joined, names those that did not."""
        links: dict[int, socket.socket] = {}
        with socket.create_server(("", port)) as door:
            while len(links) < processes - 1 and select.select([door], [], [], max(0.0, until - time.monotonic()))[0]:
                link = door.accept()[0]
                link.settimeout(BEAT)
                try:
                    links[int(link.recv(20))] = link
                except (OSError, ValueError):  # a stranger
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
                self._tell(b"\n")
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
        self._tell(f"{self.lost}\n".encode())

    def _tell(self, words: bytes) -> None:
        for link in self._links.values():
            try:
                link.sendall(words)
            except OSError:  # the next `recv` says who that was
                continue

    def waited_for(self, exchange: Callable[[], Any]) -> Any:
        """The result of a call that waits for all others; PeerLost as soon as one of them is lost."""
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
                atexit.register(os._exit, 2)  # the call that waits for ever would keep the process
                raise PeerLost(self.lost)
        if "error" in found:
            until = time.monotonic() + GRACE
            while not self.lost and time.monotonic() < until:
                time.sleep(BEAT / 10)
            raise PeerLost(self.lost or str(found["error"]).splitlines()[0]) from found["error"]
        return found["result"]
