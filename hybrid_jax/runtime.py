"""Process-wide JAX set-up: one device per CPU core, XLA options, compilation cache and precision."""

import contextlib
import errno
import os
import platform
import tempfile
import time
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Hashable
from functools import cache, partial, wraps
from importlib.metadata import version
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import numpy as np
import platformdirs
from jax.core import Tracer
from jaxlib import lapack

PROGRAMS = "JAX_COMPILATION_CACHE_DIR"
CPUS = Path("/proc/cpuinfo")
FLAGS = "XLA_FLAGS"
EXTRA = "--xla_backend_extra_options"
# XLA compiles a loop without matrix products into one kernel if it touches at most this many bytes, by default 1024.
# Kernels over 13 numbers of a minibatch cost less than their launches, so the limit is raised.
WHOLE_LOOPS = f"{EXTRA}=xla_cpu_small_while_loop_byte_threshold=10000000"
# Compiler options for large programs, or programs that run seldom. Fusion emitters make a gradient step faster, but
# least squares and predictions compile in half the time without them. Compiling a program as a whole takes a fifth less
# processor time than in parts for several threads. Later versions may not have these options.
FAST_COMPILE: dict[str, bool | int] = {}
if version("jaxlib").split(".")[:2] == ["0", "10"]:
    FAST_COMPILE |= {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
LEVEL = "xla_backend_optimization_level"
# At optimisation level 1 the simulator compiles in two thirds of the time of level 3, and flights are 3 % slower. At
# level 0 they are five times slower. Other programs keep a level that XLA_FLAGS sets, as it does for tests.
COMPILE_FLIGHTS = FAST_COMPILE | {LEVEL: 1}
FASTEST_COMPILE = FAST_COMPILE if LEVEL in os.environ.get(FLAGS, "") else COMPILE_FLIGHTS
UNOPTIMISED = FAST_COMPILE | {LEVEL: 0}  # for programs that compute little
UNUSED = 30 * 24 * 3600  # s after which unused programs are deleted: their source has changed
MOST = 2**30  # bytes of programs; beyond, those used longest ago are deleted
THREADS = "OPENBLAS_NUM_THREADS"
SIZES = 2  # sizes of data for which a function keeps its programs

P = ParamSpec("P")
R = TypeVar("R")
_owner: dict[str, int] = {}  # the process that first computed
_sized: list[Any] = []  # programs of `jit_by_size`
_sizes: dict[str, set[Hashable]] = {}  # sizes of data of each function, since programs were last deleted


def configure(folder: Path | None = None) -> None:
    """Configure JAX. You should call this before you create the first array: later, devices and XLA options are fixed.

    Args:
        folder: folder for compiled programs, by default `programs` in the user's cache folder for hybrid_jax.
            JAX_COMPILATION_CACHE_DIR takes precedence. Others should not be able to write to a folder that you name,
            because they could run code as you. Old programs are deleted only in the default folder.

    Warns if JAX has already started: its devices and XLA options stay as they are, and the rest is set.

    Raises:
        ValueError: if the folder cannot be written or, by default, if others can write it.
    """
    given = os.environ.get(PROGRAMS) or folder
    try:
        programs = Path(given) if given else private_folder("programs")
        programs.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=programs).close()
        if not given:
            _delete_stale(programs)
    except OSError as error:
        where = given or platformdirs.user_cache_dir("hybrid_jax")
        raise ValueError(f"{where}: cannot be used: {error.strerror}; {PROGRAMS} can name another folder") from error
    if EXTRA not in (flags := os.environ.get(FLAGS, "")):
        os.environ[FLAGS] = f"{flags} {WHOLE_LOOPS}".strip()
    try:
        jax.config.update("jax_num_cpu_devices", cores())
    except RuntimeError:
        warnings.warn(
            f"JAX has already started: its {jax.local_device_count()} device(s) and XLA's options stay as they are; "
            "call hybrid_jax.runtime.configure() before the first array is made. Everything else is set.",
            stacklevel=2,
        )
    jax.config.update("jax_compilation_cache_dir", str(programs))
    # XLA's own caches put their folder into the key of every program, so that a moved cache would be useless.
    jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    # A GPU's default rounds the factors of a product to 10 bits, an error of 0.6 % in a gradient. No effect on a CPU.
    jax.config.update("jax_default_matmul_precision", "float32")
    load_lapack()


def private_folder(name: str) -> Path:
    """Make a folder for code in the user's cache folder; PermissionError if others own it or can write it."""
    folder = Path(platformdirs.user_cache_dir("hybrid_jax")) / name
    for each in (folder.parent, folder):
        each.mkdir(0o700, parents=True, exist_ok=True)
        about = each.stat()
        if hasattr(os, "getuid") and (about.st_uid != os.getuid() or about.st_mode & 0o022):
            raise PermissionError(errno.EPERM, f"others can write to {each}, which contains code; delete it")
    return folder


@cache
def load_lapack() -> None:
    """Load SciPy's LAPACK, which JAX uses, with one thread by default: two can slow a small QR down 100 times."""
    unset = THREADS not in os.environ
    os.environ.setdefault(THREADS, "1")
    lapack.prepare_lapack_call("potrf_ffi", np.dtype("f4"))
    if unset:
        del os.environ[THREADS]  # other libraries and child processes should not see it


def entry(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a public function: use NumPy's promotion, and raise an error in a process forked after JAX started."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if _owner.setdefault("process", os.getpid()) != os.getpid():
            raise RuntimeError(
                f"{function.__name__}: this process was forked from one that has used JAX, whose threads it lacks; "
                "start it by multiprocessing.get_context('spawn')"
            )
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return function(*args, **kwargs)

    return call


def jit_with(options: dict[str, bool | int] | None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return `equinox.filter_jit` with compiler options, which its type annotation lacks."""
    return partial(eqx.filter_jit, compiler_options=options)  # pyright: ignore[reportCallIssue, reportReturnType]


def jit_by_size(options: dict[str, bool | int] | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile like `jit_with`. Each size of data has its own program of some 20 MiB, which `keep_programs` deletes.

    Inside another compiled function, which has its own options, the function is only traced.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        _sized.append(compiled := jit_with(options)(function))

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs)))
            return (function if traced else compiled)(*args, **kwargs)

        return call if options else compiled

    return decorate


def keep_programs(function: str, size: Hashable) -> None:
    """Delete all programs of `jit_by_size` when a function meets its third size of data since the last time."""
    sizes = _sizes.setdefault(function, set())
    if size not in sizes and len(sizes) == SIZES:
        for program in _sized:
            program._cached.clear_cache()
        _sizes.clear()
    _sizes.setdefault(function, set()).add(size)


def machine() -> tuple[str, ...]:
    """Return what a compiled program depends on: XLA options, devices and the processor's instructions."""
    lines = CPUS.read_text().splitlines() if CPUS.exists() else []
    flags = next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
    return os.environ.get(FLAGS, ""), str(jax.devices()), platform.machine(), flags


def cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def hardware() -> dict[str, Any]:
    """Return processor, cores, memory [GiB] and JAX devices, as JSON values."""
    lines = CPUS.read_text().splitlines() if CPUS.exists() else []  # only on Linux
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    try:
        memory = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, ValueError, OSError):  # not POSIX
        memory = None
    return {
        "cpu": names[0] if names else platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "memory_gib": memory,
        "jax_backend": jax.default_backend(),
        "jax_devices": [f"{count} × {kind}" for kind, count in Counter(d.device_kind for d in jax.devices()).items()],
    }


def _delete_stale(programs: Path) -> None:
    """Delete programs that are unused for `UNUSED`, beyond `MOST`, or half written. JAX would warn about the latter."""
    looked = programs / ".verified"
    since = looked.stat().st_mtime if looked.exists() else 0.0
    looked.touch()  # first, so that programs written meanwhile are verified next time
    size = 0
    with contextlib.suppress(FileNotFoundError):  # deleted by another process
        about = {path: path.stat() for path in programs.glob("*-cache") if path.is_file()}
        used = {path: max(each.st_atime, each.st_mtime) for path, each in about.items()}
        for path in sorted(about, key=used.__getitem__, reverse=True):
            size += about[path].st_size
            begun = about[path].st_mtime >= since and _is_truncated(path.read_bytes())
            if begun or size > MOST or time.time() - used[path] > UNUSED:
                path.unlink()


def _is_truncated(program: bytes) -> bool:
    """Whether a zlib stream ends too early; zstandard is not checked."""
    stream = zlib.decompressobj()
    try:
        stream.decompress(program)
    except zlib.error:
        return False
    return not stream.eof
