"""How this process uses the machine: a JAX device for each CPU core, small loops compiled whole, programs kept.

And in what precision: products of single precision are that on a GPU as well.
"""

import contextlib
import os
import zlib
from importlib.metadata import version
from pathlib import Path

import jax

PROGRAMS = "JAX_COMPILATION_CACHE_DIR"
PROGRAM = "*-cache"
VERIFIED = ".verified"
FLAGS = "XLA_FLAGS"
EXTRA = "--xla_backend_extra_options"
# XLA runs a loop kernel by kernel, and one that passes over 13 numbers of a minibatch costs less than its launch. It
# makes one kernel of a loop without matrix products that touches no more than so many bytes, by default 1024.
WHOLE_LOOPS = f"{EXTRA}=xla_cpu_small_while_loop_byte_threshold=10000000"
# Compiler options of what runs seldom or is large. XLA's fusion emitters make a gradient step faster, but least squares
# and predictions compile in half the time without; later versions may have no other way.
FAST_COMPILE: dict[str, bool | int] = {}
if version("jaxlib").split(".")[:2] == ["0", "10"]:
    FAST_COMPILE["xla_cpu_use_fusion_emitters"] = False
# At its first level of optimisation the simulator compiles in two thirds of the time of its third, for flights that are
# 3 % slower. None at all, which XLA_FLAGS may ask for, makes them five times as slow.
FASTEST_COMPILE = FAST_COMPILE | {"xla_backend_optimization_level": 1}


def configure(cache: Path) -> None:
    """Set all of it up; call it before the first array is made, because JAX's devices are fixed by then.

    Programs are kept in the cache folder, or where JAX's own variable JAX_COMPILATION_CACHE_DIR says. Those that a
    kill left half written are deleted: JAX would warn of each in every run, compile it anew and never replace it.

    Raises:
        ValueError: the folder cannot be made.
    """
    programs = Path(os.environ.get(PROGRAMS) or cache / "programs")
    try:
        programs.mkdir(parents=True, exist_ok=True)
        _delete_half_written(programs)
    except OSError as error:
        where = f"{PROGRAMS} {programs}" if os.environ.get(PROGRAMS) else f"--cache {cache}"
        raise ValueError(f"{where}: cannot be written: {error.strerror}") from error
    if EXTRA not in (flags := os.environ.get(FLAGS, "")):
        os.environ[FLAGS] = f"{flags} {WHOLE_LOOPS}".strip()
    jax.config.update("jax_num_cpu_devices", cores())
    jax.config.update("jax_compilation_cache_dir", str(programs))
    # XLA's own caches would put their folder into the key of every program, and none would be found in a moved cache.
    jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    # A GPU's default rounds the factors of a product to 10 bits, which is 0.6 % of a gradient; on a CPU it is the same.
    jax.config.update("jax_default_matmul_precision", "float32")


def cores() -> int:
    """The CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _delete_half_written(programs: Path) -> None:
    verified = programs / VERIFIED
    since = verified.stat().st_mtime_ns if verified.exists() else 0
    verified.touch()  # before looking, so that what is written meanwhile is verified next time
    for path in programs.glob(PROGRAM):
        with contextlib.suppress(FileNotFoundError):  # another process that starts was faster
            if path.stat().st_mtime_ns >= since and _half_written(path.read_bytes()):
                path.unlink()


def _half_written(program: bytes) -> bool:
    """Whether it is a zlib stream that ends too early; what zstandard wrote, where that is installed, is not judged."""
    stream = zlib.decompressobj()
    try:
        stream.decompress(program)
    except zlib.error:
        return False
    return not stream.eof
