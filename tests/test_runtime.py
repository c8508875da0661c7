"""How a process is set up."""

import os
import subprocess
import sys

from hybrid_jax.runtime import PROGRAMS

PROGRAM = """
import sys
from pathlib import Path
import jax
from hybrid_jax.runtime import configure, cores
configure(Path(sys.argv[1]))
events = []
jax.monitoring.register_event_listener(lambda name, **_: events.append(name))
jax.jit(lambda x: x @ x.T)(jax.numpy.ones((5, 5)))
assert len(jax.devices()) == cores()
print(events.count("/jax/compilation_cache/cache_hits"), events.count("/jax/compilation_cache/cache_misses"))
"""


def hits_and_misses(cache):
    own = {name: value for name, value in os.environ.items() if name != PROGRAMS}  # not the cache of all tests
    command = [sys.executable, "-c", PROGRAM, str(cache)]
    run = subprocess.run(command, env=own, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return [int(number) for number in run.stdout.split()[-2:]]


def test_programs_are_found_again_wherever_their_cache_was_moved(tmp_path):
    hits, compiled = hits_and_misses(tmp_path / "here")
    assert hits == 0
    assert compiled > 0
    (tmp_path / "here").rename(tmp_path / "there")
    assert hits_and_misses(tmp_path / "there") == [compiled, 0]


def test_programs_that_a_kill_left_half_written_are_replaced(tmp_path):
    _, compiled = hits_and_misses(tmp_path)
    whole, empty = sorted((tmp_path / "programs").glob("*-cache"), key=lambda path: path.stat().st_size)[-2:]
    os.truncate(whole, whole.stat().st_size - 1)
    os.truncate(empty, 0)
    assert hits_and_misses(tmp_path) == [compiled - 2, 2]
    assert hits_and_misses(tmp_path) == [compiled, 0]
