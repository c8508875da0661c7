"""Compile C++ with GCC for XLA at first use, cache it in the user's folder, verify it and load it.

GCC runs while XLA compiles the caller, and the first call waits for it, so results do not depend on timing. Because the
cache contains code, its folder must belong to the user, and a library whose checksum is wrong is recompiled.
HYBRID_JAX_NATIVE=0 disables kernels; `obstacle` reports other reasons.
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
# Runs a command; once standard input is closed, ends it with all that it began, and deletes the folder $0.
WATCHED = """
exec 3<&0
{ read -r _ <&3; trap '' TERM; kill 0; rm -rf "$0"; } &
"$@" 3<&- </dev/null
code=$?
kill $!
exit $code
"""

Results = jax.ShapeDtypeStruct | Sequence[jax.ShapeDtypeStruct]
_LOCK = threading.Lock()  # programs are traced in several threads


class Unusable(Exception):
    """The library is unavailable."""


@cache
def obstacle() -> str | None:
    """Return why kernels are unavailable in this process, or None."""
    try:
        _check_machine()
        _folder()
    except Unusable as reason:
        return str(reason)
    except OSError as error:
        return f"they could not be kept: {error}"
    return None


def compiled(source: str, needs_math: bool) -> str:
    """Compile and register a source; return the prefix of its XLA targets, or raise Unusable."""
    with _LOCK:
        return _registered(source, needs_math)


def call(handler: str, results: Results, *arrays, numbers: Sequence[float] = ()):
    """Call a kernel on arrays, whose number, type and shapes are not checked, and constants; `vmap` makes one call."""
    kernel = jax.ffi.ffi_call(handler, results, vmap_method="broadcast_all")
    return kernel(*arrays, numbers=np.array(numbers, np.float32))


def with_derivative(kernel: Callable, plain: Callable) -> Callable:
    """Wrap a kernel so that its second derivative uses plain JAX."""
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
    """Register the library if it exists, else placeholders that wait for its compilation."""
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
    """Describe what a library depends on besides its source."""
    compiler = Path(_compiler() or "").resolve()
    made_by = compiler, compiler.stat().st_mtime_ns, OPTIONS, jax.__version__, runtime.machine()[-2:]
    return "".join(path.read_text() for path in sorted(SOURCES.iterdir())) + repr(made_by)


def _folder() -> Path:
    """Return the cache folder, which must not be accessible to others."""
    folder = Path(platformdirs.user_cache_dir("hybrid_jax")) / "kernels"
    folder.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or stat.S_IMODE(about.st_mode) & 0o077:
        raise Unusable(f"{folder} must be a folder of this user with mode 0700")
    return folder


def _checked_library(digest: str, source: str, needs_math: bool) -> Path:
    """Return the library's file, compiled if it is missing or corrupt."""
    library = _folder() / f"{digest}.so"
    if not _is_whole(library):
        _compile(library, source, needs_math)
    library.touch()  # it was used
    return library


def _is_whole(library: Path) -> bool:
    """Whether the checksum at the end, which loaders ignore, matches the rest."""
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
    for path in library.parent.glob("*"):  # of other sources or compilers, and what was left half written
        with contextlib.suppress(FileNotFoundError):  # deleted by another process
            if time.time() - path.stat().st_mtime > (2 * LONGEST if path.is_dir() else runtime.UNUSED):
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _run_compiler(arguments: list[str]) -> None:
    """Compile into the folder of the last argument; if this process ends first, so do compiler and folder."""
    command, folder = [_compiler() or "g++", *OPTIONS, *arguments], Path(arguments[-1]).parent
    inside, held = os.pipe()  # closed by the system when this process ends, also by SIGKILL
    try:
        subprocess.run(
            ["sh", "-c", WATCHED, folder, *command],
            check=True,
            capture_output=True,
            text=True,
            timeout=LONGEST,
            stdin=inside,
            env=os.environ | {"TMPDIR": str(folder)},
            start_new_session=True,
        )
    except subprocess.SubprocessError as error:
        said = [line for line in (getattr(error, "stderr", None) or "").splitlines() if "error" in line]
        raise Unusable(f"it could not be compiled: {(said or [f'{command[0]} fails'])[0]}") from error
    finally:
        os.close(inside)
        os.close(held)
