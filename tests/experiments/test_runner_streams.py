"""A lost terminal, or one that cannot show a letter, costs no run its results."""

import io
import signal
import subprocess
import sys
from dataclasses import dataclass

import pytest

from experiments.runner.checkpoint import DeferredSignals
from experiments.runner.command import call


@dataclass(frozen=True)
class Nothing:
    """No options."""


def test_what_a_stream_cannot_encode_is_replaced(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    call("nothing", Nothing, lambda _: print("θ ≤ 1"), [])
    stream.flush()
    assert stream.buffer.getvalue() == b"? ? 1\n"


MANY_LINES = """
import sys
from hybrid_jax.cli.command import exit_codes
with exit_codes("program", "program", ""):
    for line in range(20_000):
        print(line)
    open(sys.argv[1], "w").write("whole")
"""


def test_where_standard_output_is_closed_the_work_is_still_done(tmp_path):
    run = [sys.executable, "-c", MANY_LINES, tmp_path / "report"]
    with subprocess.Popen(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert "program: standard output: Broken pipe" in process.stderr.read()
    assert process.returncode == 0
    assert (tmp_path / "report").read_text() == "whole"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_lost_connection_is_deferred_like_an_end(number):
    met = []
    before = signal.signal(number, lambda *_: met.append(number))
    try:
        with DeferredSignals() as signals:
            signal.raise_signal(number)
            assert signals.pending == number
            assert not met
        assert met == [number]
    finally:
        signal.signal(number, before)
