"""Memory stays flat over many sweeps in one process."""

import gc
import os
import weakref
from pathlib import Path

import jax
import numpy as np
import pytest
from pendulum import DAMPING, pendulum, swings
from smoke import script

from hybrid_jax.sweep.lanes import stack
from hybrid_jax.sweep.training import PROGRAMS, _block, evaluate, sweep
from hybrid_jax.training.fitting import make_run_config, start
from hybrid_jax.training.objective import Settings

PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 0
SWEEPS, WARM = 200, 40  # caches and the allocator have settled after WARM sweeps
GROWTH = 1.05


def resident():
    """Memory of this process in bytes, after garbage collection."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def soak(sizes):
    """Resident memory after the warm-up and at the end of sweeps of pendulums on so many windows in turn."""
    settings, validation = Settings(batch_size=5), swings(8, seed=1)
    for i in range(SWEEPS):
        size = sizes[i % len(sizes)]
        states = stack([start(pendulum(length, DAMPING), jax.random.key(i)) for length in (0.8, 0.6)])
        plans = stack([make_run_config(rate, np.arange(size), size, 1, 2, 6, 0.0) for rate in (0.03, 0.01)])
        final = sweep(states, plans, swings(40)[:size], validation, settings)
        evaluate(final.best, validation, 2, settings)
        if i + 1 == WARM:
            warm = resident()
    return warm, resident()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from Linux's /proc")
def test_memory_is_flat_after_the_warm_up():
    paths = "import sys; sys.path[:0] = ['tests', 'tests/experiments']"
    code = f"{paths}; from test_soak import soak; print(*soak([10, 15]))"
    warm, last = map(int, script("-c", code).split())
    assert last < GROWTH * warm, f"{warm / 2**20:.0f} MiB, then {last / 2**20:.0f} MiB"


def test_programs_of_old_shapes_are_freed():
    """Otherwise each shape would leave a compiled program behind."""
    settings = Settings(batch_size=7)
    kept = [weakref.ref(_block(settings, (), 1, 2, (shape,))) for shape in range(PROGRAMS + 1)]
    gc.collect()  # a map and its compiled function refer to each other
    assert [map_() is None for map_ in kept] == [True] + [False] * PROGRAMS
