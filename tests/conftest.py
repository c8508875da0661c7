"""Tests spend most of their time compiling: programs are compiled without optimisation, and kept for the next run.

`XLA_FLAGS= pytest` compiles them as users do. JAX finds a program by what it computes, so a change of the code compiles
what it changes. Each process of tests keeps to one core: XLA starts a thread for every core that a process may use, and
those of two processes wait for each other.
"""

import gc
import os
import signal
from importlib.metadata import version

import platformdirs
import pytest

# Without optimisation a third of the time to compile, and three quarters of that in one part, as suits one core. XLA
# aborts on a flag that it does not know.
QUICK = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
if tuple(map(int, version("jaxlib").split(".")[:2])) <= (0, 10):
    QUICK += " --xla_cpu_use_fusion_emitters=false"
# JAX reads these when it is imported, so it must not be imported here. The last three are as in `runtime.configure`.
ENVIRONMENT = {
    "XLA_FLAGS": QUICK,
    "JAX_TRACEBACK_IN_LOCATIONS_LIMIT": "0",  # a sixth of the time to compile; errors of XLA lose their lines
    "JAX_COMPILATION_CACHE_DIR": str(platformdirs.user_cache_path("hybrid_jax") / "tests"),
    "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES": "none",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}
for name, value in ENVIRONMENT.items():  # at once, as conftest.py of a folder that is given to pytest imports JAX
    os.environ.setdefault(name, value)
CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []  # other systems bind no process


def pytest_configure(config):
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")  # gw0, gw1, …
    if worker and CORES:
        os.sched_setaffinity(0, {CORES[int(worker.removeprefix("gw")) % len(CORES)]})


def pytest_collection_modifyitems(items):
    """The longest files first, so that the two processes end together; the last ones compile hardly anything."""
    items.sort(key=lambda item: "tests/training" not in item.nodeid)


def pytest_collection_finish():
    """Collect garbage seldom: to look through a million objects of JAX takes seconds, and most are there to stay."""
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


def pytest_sessionfinish():
    gc.freeze()  # pytest collects garbage once more, which takes seconds, too


@pytest.fixture(scope="module")
def all_cores():
    """Subprocesses may use every core, not that of this process alone."""
    if CORES:
        own = os.sched_getaffinity(0)
        os.sched_setaffinity(0, CORES)
    yield
    if CORES:
        os.sched_setaffinity(0, own)


@pytest.fixture
def heard():
    """SIGINT acts here and in subprocesses, also where pytest is a background job, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def double_precision():
    import jax

    with jax.enable_x64(True):
        yield
