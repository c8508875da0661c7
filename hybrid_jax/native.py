"""Kernels in C++ that XLA calls, in place of many small kernels of its own.

They are compiled by GCC at first use, which takes some seconds, and kept in the user's cache folder. Where that is not
possible, and for anything but single precision on a processor with AVX2, JAX does the same: `status` tells which.
HYBRID_JAX_NATIVE=0 switches them off. Both ways agree to rounding, so a run should be continued the way it began.
"""

import contextlib
import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import jax
import numpy as np
import platformdirs

from hybrid_jax import runtime

SWITCH = "HYBRID_JAX_NATIVE"
VECTOR = 16  # numbers in a vector, at most: of samples the kernels take at least so many
UNITS = 2 * VECTOR  # hidden units that a kernel works on at once, at most: their number is a multiple of it
FOLDER = Path(__file__).parent / "kernels"
SOURCES = [FOLDER / f"{name}.cc" for name in ("normalised_layer", "rollout", "prediction")]
HANDLERS = "normalised_layer_forward", "normalised_layer_backward", "rollout_forward", "rollout_backward", "prediction"
# Errors and exceptions of the square root are not asked for: without them several are taken at once.
OPTIONS = ["-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-w"]
LONGEST = 300  # s to compile

Results = jax.ShapeDtypeStruct | Sequence[jax.ShapeDtypeStruct]
_LOCK = threading.Lock()  # programs are traced in several threads


def status() -> str:
    """Whether kernels are used in this process: "used", or why not. Compiles them if need be."""
    return _obstacle() or ("used" if prefix() else "not used: they could not be compiled, or not be kept")


def prefix() -> str | None:
    """What the targets' names begin with, once compiled and registered with XLA; None where there are no kernels."""
    with _LOCK:
        return _compiled()


def call(handler: str, results: Results, *arrays, numbers: Sequence[float] = ()):
    """What a kernel makes of the arrays, whose number, type and shapes it does not check, and of some fixed numbers.

    Lanes under `vmap` are one call.
    """
    kernel = jax.ffi.ffi_call(f"{prefix()}{handler}", results, vmap_method="broadcast_all")
    return kernel(*arrays, numbers=np.array(numbers, np.float32))


def with_derivative(kernel: Callable, plain: Callable) -> Callable:
    """The kernel, which for a second derivative becomes the same in plain JAX."""
    function = jax.custom_jvp(kernel)
    function.defjvp(lambda arrays, tangents: jax.jvp(plain, arrays, tangents))
    return function


@cache
def _compiled() -> str | None:
    if _obstacle():
        return None
    try:
        if not _library().exists():
            _compile()
        return _register()
    except (OSError, subprocess.SubprocessError, AttributeError):
        return None


def _register() -> str:
    begin = f"hybrid_jax_{_digest()}_"
    library = ctypes.CDLL(str(_library()))
    with contextlib.suppress(OSError):
        _library().touch()  # it was used
    for handler in HANDLERS:
        jax.ffi.register_ffi_target(begin + handler, jax.ffi.pycapsule(getattr(library, handler)), platform="cpu")
    return begin


@cache
def _obstacle() -> str | None:
    if os.environ.get(SWITCH) == "0":
        return f"not used: {SWITCH} is 0"
    if jax.default_backend() != "cpu":
        return f"not used: arrays are on a {jax.default_backend()}"
    if not {"avx2", "fma"} <= set(runtime.machine()[-1].split()):
        return "not used: the processor has no AVX2"
    return None if _compiler() else "not used: there is no g++"


def _compiler() -> str | None:
    return shutil.which(os.environ.get("CXX") or "g++")


@cache
def _digest() -> str:
    compiler = Path(_compiler() or "").resolve()
    made_by = compiler, compiler.stat().st_mtime_ns, OPTIONS, jax.__version__, runtime.machine()[-2:]
    sources = b"".join(path.read_bytes() for path in sorted(FOLDER.iterdir()))
    return hashlib.sha256(sources + repr(made_by).encode()).hexdigest()[:16]


def _library() -> Path:
    return Path(platformdirs.user_cache_dir("hybrid_jax")) / "native" / f"{_digest()}.so"


def _compile() -> None:
    library = _library()
    library.parent.mkdir(parents=True, exist_ok=True)
    part = library.with_name(f".{library.name}.{os.getpid()}.part")
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor() as threads:
        objects = [Path(folder) / f"{source.stem}.o" for source in SOURCES]
        include = f"-I{jax.ffi.include_dir()}"
        commands = [["-c", include, str(source), "-o", str(to)] for source, to in zip(SOURCES, objects, strict=True)]
        list(threads.map(_run_compiler, commands))
        _run_compiler(["-shared", *map(str, objects), "-o", str(part)])
    os.replace(part, library)
    _delete_unused(library.parent)


def _run_compiler(arguments: list[str]) -> None:
    command = [_compiler() or "g++", *OPTIONS, *arguments]
    subprocess.run(command, check=True, capture_output=True, timeout=LONGEST)


def _delete_unused(folder: Path) -> None:
    """Delete libraries of other sources or compilers, and what a kill left half written."""
    for path in folder.glob("*"):
        with contextlib.suppress(FileNotFoundError):  # deleted by another process
            if time.time() - path.stat().st_mtime > runtime.UNUSED:
                path.unlink()
