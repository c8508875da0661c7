"""A library of C++ that XLA calls: compiled by GCC at first use, kept in the user's cache folder, checked and loaded.

GCC works while XLA compiles what calls the library; the first call waits for it. So results do not depend on when it is
there, and a run that is resumed goes on as it began.

What is kept is code, so the folder must be the user's alone, and a library that is not as it was written is compiled
anew. HYBRID_JAX_NATIVE=0 switches kernels off; `obstacle` tells what else does.
"""

import contextlib
import ctypes
import hashlib
import itertools
import os
import shutil
import stat
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import jax
import numpy as np
import platformdirs

from hybrid_jax import runtime

SWITCH = "HYBRID_JAX_NATIVE"
SOURCES = Path(__file__).parent / "cpp"
HANDLERS = "forward", "backward"
# Errors and exceptions of the square root are not asked for: without them several are taken at once.
OPTIONS = ["-std=c++17", "-O2", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-w"]
LONGEST = 300  # s to compile
CHECKSUM = 32  # bytes

Results = jax.ShapeDtypeStruct | Sequence[jax.ShapeDtypeStruct]
_LOCK = threading.Lock()  # programs are traced in several threads


class Unusable(Exception):
    """Why there is no library."""


@cache
def obstacle() -> str | None:
    """Why there are no kernels in this process, or None."""
    try:
        _check_machine()
        _folder()
    except Unusable as reason:
        return str(reason)
    except OSError as error:
        return f"they could not be kept: {error}"
    return None


def compiled(source: str, needs_math: bool) -> str:
    """What the names of XLA's targets of a source begin with, once it is compiled and registered; else Unusable."""
    with _LOCK:
        return _registered(source, needs_math)


def call(handler: str, results: Results, *arrays, numbers: Sequence[float] = ()):
    """What a kernel makes of the arrays, whose number, type and shapes it does not check, and of some fixed numbers.

    Lanes under `vmap` are one call.
    """
    kernel = jax.ffi.ffi_call(handler, results, vmap_method="broadcast_all")
    return kernel(*arrays, numbers=np.array(numbers, np.float32))


def with_derivative(kernel: Callable, plain: Callable) -> Callable:
    """The kernel, which for a second derivative becomes the same in plain JAX."""
    function = jax.custom_jvp(kernel)
    function.defjvp(lambda arrays, tangents: jax.jvp(plain, arrays, tangents))
    return function


def _check_machine() -> None:
    if os.environ.get(SWITCH) == "0":
        raise Unusable(f"{SWITCH} is 0")
    if jax.default_backend() != "cpu":
        raise Unusable(f"arrays are on a {jax.default_backend()}")
    if not {"avx2", "fma"} <= set(runtime.machine()[-1].split()):
        raise Unusable("the processor has no AVX2")
    if not _compiler():
        raise Unusable("there is no g++")


def _compiler() -> str | None:
    return shutil.which(os.environ.get("CXX") or "g++")


@cache
def _registered(source: str, needs_math: bool) -> str:
    """Registers the library if it is there, else doors to it, behind which it is compiled."""
    begin = f"hybrid_jax_{_digest(source)}_"
    handlers = HANDLERS if "#define TRAINING 1" in source else HANDLERS[:1]
    try:
        doors, places = _doors(), [next(_PLACES) for _ in handlers]
        whole = _is_whole(_folder() / f"{_digest(source)}.so") or not doors.door_at(places[-1])
        found = _addresses(source, needs_math, handlers) if whole else [doors.door_at(place) for place in places]
    except OSError as error:
        raise Unusable(f"they could not be kept, or not be loaded: {error}") from error
    for handler, address in zip(handlers, found, strict=True):
        jax.ffi.register_ffi_target(begin + handler, jax.ffi.pycapsule(address), platform="cpu")
    if not whole:
        threading.Thread(target=_open, args=(doors, places, source, needs_math, handlers), daemon=True).start()
    return begin


def _open(doors: ctypes.CDLL, places: Sequence[int], source: str, needs_math: bool, handlers: Sequence[str]) -> None:
    behind = (ctypes.c_void_p * (places[-1] + 1)).in_dll(doors, "behind")
    try:
        found = _addresses(source, needs_math, handlers)
    except (OSError, Unusable):  # then whoever waits must not wait on
        found = [ctypes.cast(doors.refuse, ctypes.c_void_p).value for _ in handlers]
    for place, address in zip(places, found, strict=True):
        behind[place] = address


def _addresses(source: str, needs_math: bool, handlers: Sequence[str]) -> list[int | None]:
    library = ctypes.CDLL(str(_checked_library(_digest(source), source, needs_math)))
    return [ctypes.cast(getattr(library, one), ctypes.c_void_p).value for one in handlers]


@cache
def _doors() -> ctypes.CDLL:
    source = (SOURCES / "doors.cc").read_text()
    doors = ctypes.CDLL(str(_checked_library(_digest(source), source, needs_math=False)))
    doors.door_at.restype = ctypes.c_void_p
    return doors


_PLACES = itertools.count()


def _digest(source: str) -> str:
    return hashlib.sha256((source + _made_by()).encode()).hexdigest()[:16]


@cache
def _made_by() -> str:
    """What a library depends on besides its source."""
    compiler = Path(_compiler() or "").resolve()
    made_by = compiler, compiler.stat().st_mtime_ns, OPTIONS, jax.__version__, runtime.machine()[-2:]
    return "".join(path.read_text() for path in sorted(SOURCES.iterdir())) + repr(made_by)


def _folder() -> Path:
    """The folder of libraries, which nobody else may read or write."""
    folder = Path(platformdirs.user_cache_dir("hybrid_jax")) / "kernels"
    folder.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or stat.S_IMODE(about.st_mode) & 0o077:
        raise Unusable(f"{folder} must be a folder of this user with mode 0700")
    return folder


def _checked_library(digest: str, source: str, needs_math: bool) -> Path:
    """The file of the library, compiled if there is none, or none that is as it was written."""
    library = _folder() / f"{digest}.so"
    if not _is_whole(library):
        _compile(library, source, needs_math)
    library.touch()  # it was used
    return library


def _is_whole(library: Path) -> bool:
    """Whether the checksum at its end, which loaders do not read, is that of the rest."""
    content = library.read_bytes() if library.exists() else b""
    return content[-CHECKSUM:] == hashlib.sha256(content[:-CHECKSUM]).digest()


def _compile(library: Path, source: str, needs_math: bool) -> None:
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        (text := Path(folder) / "field.cc").write_text(source)
        include = [f"-I{jax.ffi.include_dir()}", f"-I{SOURCES}"]
        linked = Path(folder) / library.name
        _run_compiler(["-shared", *include, str(text), *["-lmvec"] * needs_math, "-o", str(linked)])
        with linked.open("r+b") as file:
            file.write(hashlib.sha256(file.read()).digest())
            file.flush()
            os.fsync(file.fileno())  # there whole or not at all, also after a power cut
        os.replace(linked, library)
    for path in library.parent.glob("*"):  # of other sources or compilers, and what a kill left half written
        with contextlib.suppress(FileNotFoundError):  # deleted by another process
            if time.time() - path.stat().st_mtime > runtime.UNUSED:
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _run_compiler(arguments: list[str]) -> None:
    command = [_compiler() or "g++", *OPTIONS, *arguments]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=LONGEST, start_new_session=True)
    except subprocess.SubprocessError as error:
        said = [line for line in (getattr(error, "stderr", None) or "").splitlines() if "error" in line]
        raise Unusable(f"it could not be compiled: {(said or [f'{command[0]} fails'])[0]}") from error
