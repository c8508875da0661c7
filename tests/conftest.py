"""Compiling is most of what a run of the tests does: programs are not optimised, and kept for all processes.

`XLA_FLAGS= pytest` has them optimised, as users have.
"""

import os
import shutil
import signal
import tempfile
from importlib.metadata import version

import pytest

# All are read when JAX is imported, which must not happen here; the others are as `runtime.configure` sets them.
PROGRAMS = "JAX_COMPILATION_CACHE_DIR"
KEEP_ALL = {
    "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES": "none",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}
# A third of the time to compile. XLA ends a process that gives it a flag which it does not know.
QUICK = "--xla_backend_optimization_level=0"
if tuple(map(int, version("jaxlib").split(".")[:2])) <= (0, 10):
    QUICK += " --xla_cpu_use_fusion_emitters=false"


def pytest_configure(config):
    if PROGRAMS not in os.environ:
        folder = os.environ[PROGRAMS] = tempfile.mkdtemp(prefix="hybrid_jax_programs_")
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    for name, value in (KEEP_ALL | {"XLA_FLAGS": QUICK}).items():
        os.environ.setdefault(name, value)


@pytest.fixture
def heard():
    """Ctrl-C is heard, here and by what is started, also where pytest is a background job, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
