"""One cache of compiled programs for all workers and the processes that tests start: most of a run is compiling."""

import os
import shutil
import tempfile

# Read by JAX when it is imported, which no test file has done yet.
SHARED = {
    "JAX_COMPILATION_CACHE_DIR": None,
    "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES": "none",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}


def pytest_configure(config):
    if hasattr(config, "workerinput") or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return  # a worker has its parent's environment
    folder = tempfile.mkdtemp(prefix="hybrid_jax_programs_")
    os.environ |= {name: value or folder for name, value in SHARED.items()}
    config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
