"""Compile C++ with GCC at first use, cache it in the user's folder, verify it and load it.

GCC runs while JAX traces and XLA compiles: programs call `cpp/entry.cc`, which waits for the kernel when it runs.
Because the cache contains code, its folder must belong to the user, and a library with a wrong checksum is recompiled.
HYBRID_JAX_NATIVE=0 disables kernels; `obstacle` reports other reasons.
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
from functools import cache
from pathlib import Path
from typing import Any

import jax

from hybrid_jax import runtime

SWITCH, FOLDER = "HYBRID_JAX_NATIVE", "kernels"
SOURCES = Path(__file__).parent / "cpp"
# Without errors and exceptions of the square root, several are computed at once.
OPTIONS = ["-std=c++17", "-O2", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-w", "-shared"]
LONGEST = 300  # s to compile
CHECKSUM = 32  # bytes
# Runs a command. When standard input is closed, ends it with all its children, and deletes the folder $0.
WATCHED = """
exec 3<&0
{ read -r _ <&3; trap '' TERM; kill 0; rm -rf "$0"; } &
"$@" 3<&- </dev/null
code=$?
kill $!
exit $code
"""


class Unusable(Exception):
    """The library is unavailable."""


@cache
def obstacle() -> str | None:
    """Return why kernels are unavailable in this process, or None."""
    if os.environ.get(SWITCH) == "0":
        return f"{SWITCH} is 0"
    if jax.default_backend() != "cpu":
        return f"arrays are on a {jax.default_backend()}"
    if not {"avx2", "fma"} <= set(_flags()):
        return "the processor has no AVX2"
    if not _compiler():
        return "there is no g++"
    try:
        _entry()
    except (OSError, AttributeError, Unusable) as error:
        return str(error) if isinstance(error, Unusable) else f"they could not be saved or loaded: {error}"
    return None


def width() -> int:
    """Return how many numbers a vector has."""
    return 16 if "avx512f" in _flags() else 8


def _flags() -> list[str]:
    return runtime.machine()[-1].split()


@cache
def _entry() -> ctypes.CDLL:
    """Load and register the functions that programs call."""
    library = ctypes.CDLL(str(_checked_library((SOURCES / "entry.cc").read_text("utf-8"))))
    for handler in ("forward", "backward"):
        target = jax.ffi.pycapsule(ctypes.cast(library[handler], ctypes.c_void_p).value)
        jax.ffi.register_ffi_target(f"hybrid_jax_{handler}", target, platform="cpu")
    return library


@cache
def begun(source: str) -> str:
    """Begin to compile a source, and return the name by which programs find its functions."""
    name, entry = _digest(source), _entry()

    def run() -> None:
        ways: list[Any] = [None, None]
        problem = ""
        try:
            library = ctypes.CDLL(str(_checked_library(source)))
            ways = [getattr(library, one, None) for one in ("forward", "backward")]
        except BaseException as error:  # ends the program that calls the kernel
            problem = f"a kernel cannot be used: {error}; you can disable kernels with {SWITCH}=0"
        entry.publish(name.encode(), problem.encode(), *(ctypes.cast(one, ctypes.c_void_p) for one in ways))

    threading.Thread(target=run, daemon=True).start()  # Python does not wait for it to exit
    return name


def _compiler() -> str | None:
    return shutil.which(os.environ.get("CXX") or "g++")


def _digest(source: str) -> str:
    """Identify a source, the compiler and the machine."""
    compiler = Path(_compiler() or "").resolve()
    parts = [source.encode(), *(path.read_bytes() for path in sorted(SOURCES.iterdir()))]
    made_by = compiler, compiler.stat().st_mtime_ns, OPTIONS, jax.__version__, runtime.machine()[-2:]
    return hashlib.sha256(b"".join([*parts, repr(made_by).encode()])).hexdigest()[:16]


def _checked_library(source: str) -> Path:
    """Return the library's file, compiled if it is missing or corrupt."""
    library = runtime.private_folder(FOLDER) / f"{_digest(source)}.so"
    if not _is_whole(library):
        _compile(library, source)
    library.touch()  # it was used
    return library


def _is_whole(library: Path) -> bool:
    """Whether the checksum at the end, which loaders ignore, matches the rest."""
    content = library.read_bytes() if library.exists() else b""
    return content[-CHECKSUM:] == hashlib.sha256(content[:-CHECKSUM]).digest()


def _compile(library: Path, source: str) -> None:
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        linked, text = Path(folder) / library.name, Path(folder) / "field.cc"
        text.write_text(source)
        _run_compiler([f"-I{jax.ffi.include_dir()}", f"-I{SOURCES}", str(text), "-lmvec", "-o", str(linked)])
        with linked.open("r+b") as file:
            file.write(hashlib.sha256(file.read()).digest())
            file.flush()
            os.fsync(file.fileno())  # complete, or missing, also after a power cut
        os.replace(linked, library)
    for path in library.parent.glob("*"):  # of other sources or compilers, or incomplete
        with contextlib.suppress(FileNotFoundError):  # deleted by another process
            if time.time() - path.stat().st_mtime > (2 * LONGEST if path.is_dir() else runtime.UNUSED):
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _run_compiler(arguments: list[str]) -> None:
    """Compile into the folder of the last argument. If this process ends first, stop and delete the folder."""
    command, folder = [_compiler() or "g++", *OPTIONS, *arguments], Path(arguments[-1]).parent
    inside, held = os.pipe()  # closed by the system when this process ends, also by SIGKILL
    try:
        watched, environment = ["sh", "-c", WATCHED, folder, *command], os.environ | {"TMPDIR": str(folder)}
        options = {"capture_output": True, "errors": "replace", "timeout": LONGEST, "start_new_session": True}
        subprocess.run(watched, check=True, stdin=inside, env=environment, **options)
    except subprocess.SubprocessError as error:
        errors = [line for line in (getattr(error, "stderr", None) or "").splitlines() if "error" in line]
        raise Unusable(f"it could not be compiled: {(errors or [f'{command[0]} fails'])[0]}") from error
    finally:
        os.close(inside)
        os.close(held)
