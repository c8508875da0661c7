"""Processes that meet, hear from each other, and say which of them is lost; here threads stand for them."""

import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.hosts import PeerLost, Peers


@pytest.fixture(autouse=True)
def _fast(monkeypatch):
    monkeypatch.setattr(hosts, "BEAT", 0.05)
    monkeypatch.setattr(hosts, "GRACE", 0.2)
    monkeypatch.setattr(hosts.atexit, "register", lambda *_: None)  # the process would not end with the tests' code


def meet(*processes, of=3, timeout=1.0):
    """What becomes of these of the processes: each has met all others, or is told who did not come."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{free.getsockname()[1]}"

    def one(process):
        try:
            return Peers(where, of, process, timeout)
        except PeerLost as lost:
            return str(lost)

    with ThreadPoolExecutor() as pool:
        return list(pool.map(one, processes))


def test_a_result_is_waited_for_an_error_of_the_exchange_is_a_lost_peer_and_who_never_comes_is_named():
    one, *_ = meet(0, 1, 2)
    assert one.waited_for(lambda: 3) == 3

    def broken():
        raise RuntimeError("Gloo: connection closed\nmore")

    with pytest.raises(PeerLost, match=r"^Gloo: connection closed$"):
        one.waited_for(broken)
    assert set(meet(0, 2, timeout=0.5)) == {"process 1 did not join within 0.5 s"}
    (alone,) = meet(1, timeout=0.5)
    assert alone.startswith("process 0 at 127.0.0.1:")
    assert alone.endswith("did not join within 0.5 s")


@pytest.mark.parametrize("victim", [0, 1])
@pytest.mark.parametrize(("killed", "how"), [(True, "has ended"), (False, "has not answered for 1 s")])
def test_who_is_killed_or_stopped_is_named_by_the_others(victim, killed, how):
    all_of_them = meet(0, 1, 2)
    lost = all_of_them.pop(victim)
    lost._send = lambda words: None  # of a process that was stopped, nothing is heard
    for link in lost._links.values() if killed else ():
        link.shutdown(socket.SHUT_RDWR)
    for other in all_of_them:
        with pytest.raises(PeerLost, match=f"^process {victim} {how}$"):
            other.waited_for(threading.Event().wait)
