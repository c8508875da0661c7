"""Memory of a process that adapts again and again, to data of one size and of many."""

import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pendulum
import pytest
from smoke import script

import hybrid_jax as hj
from hybrid_jax import runtime

PATHS = "import sys; sys.path[:0] = ['tests', 'tests/adaptation']"


def adapted(method, sizes):
    """Memory [MiB] and processor time [s] after each adaptation."""
    warnings.simplefilter("ignore")
    jax.config.update("jax_enable_compilation_cache", False)  # the compiler takes 150 MiB where it is first needed
    network = hj.residual_network(2, 1, jax.random.key(0), hidden=4, norm="none", activation="tanh")
    field, flights = hj.Hybrid(pendulum.Pendulum(jnp.float32(0.0)), network), pendulum.swings(max(sizes))
    flights = jax.tree.map(np.asarray, flights)
    for size in sizes:
        began = time.process_time()
        hj.adapt(field, flights[:size], method=method)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        print(pages / 256, time.process_time() - began)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from Linux's /proc")
@pytest.mark.parametrize(("method", "sizes"), [("auto", "[40] * 500"), ("least_squares", "range(40, 90)")])
def test_memory_and_time_stay_where_they_are(method, sizes):
    """Every size of data has programs of its own, which took 46 MiB for ever."""
    code = f"{PATHS}; from test_memory import adapted; adapted({method!r}, {sizes})"
    memory, seconds = np.array([list(map(float, line.split())) for line in script("-c", code).splitlines()]).T
    assert memory[-1] - memory[1] < 100
    if sizes.startswith("["):
        assert memory[99] < 1.05 * memory[1]
        assert np.median(seconds[90:110]) < 1.5 * np.median(seconds[1:11])


def test_programs_of_a_third_size_replace_the_others():
    made = []
    program = runtime.jit_by_size()(lambda x: made.append(x.shape) or x)
    for size in (1, 2, 1, 2, 3, 3, 1):
        runtime.keep_programs("test", size)
        program(jnp.zeros(size))
    assert made == [(1,), (2,), (3,), (1,)]
