"""One cache of compiled programs for all workers and the processes that tests start: most of a run is compiling."""

import os
import shutil
import tempfile

# All are read when JAX is imported, which must not happen here; the others are as `runtime.configure` sets them.
PROGRAMS = "JAX_COMPILATION_CACHE_DIR"
KEEP_ALL = {
    "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES": "none",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}


def pytest_configure(config):
    if PROGRAMS not in os.environ:
        folder = os.environ[PROGRAMS] = tempfile.mkdtemp(prefix="hybrid_jax_programs_")
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    for name, value in KEEP_ALL.items():
        os.environ.setdefault(name, value)
