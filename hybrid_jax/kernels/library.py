"""Compile C++ with GCC for XLA at first use, keep it in the user's cache folder, verify it and load it.

GCC runs while JAX traces, which needs the library only when XLA compiles the call. Because the cache contains code,
its folder must belong to the user, and a library whose checksum is wrong is recompiled.
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
from concurrent.futures import Future
from functools import cache
from pathlib import Path

import jax

from hybrid_jax import runtime

SWITCH, FOLDER = "HYBRID_JAX_NATIVE", "kernels"
SOURCES = Path(__file__).parent / "cpp"
# Errors and exceptions of the square root are not asked for: without them several are taken at once.
OPTIONS = ["-std=c++17", "-O2", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-w", "-shared"]
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
_LOCK, _BEGUN = threading.Lock(), dict[str, Future[str]]()  # programs are traced in several threads


class Unusable(Exception):
    """The library is unavailable."""


@cache
def obstacle() -> str | None:
    """Return why kernels are unavailable in this process, or None."""
    if os.environ.get(SWITCH) == "0":
        return f"{SWITCH} is 0"
    if jax.default_backend() != "cpu":
        return f"arrays are on a {jax.default_backend()}"
    if not {"avx2", "fma"} <= set(runtime.machine()[-1].split()):
        return "the processor has no AVX2"
    if not _compiler():
        return "there is no g++"
    try:
        runtime.private_folder(FOLDER)
    except OSError as error:
        return f"they could not be kept: {error}"
    return None


def compiled(source: str) -> Future[str]:
    """Begin to compile and register a source, whose result is the prefix of its XLA targets, or the error Unusable."""
    with _LOCK:
        if source in _BEGUN:
            return _BEGUN[source]
        result = _BEGUN[source] = Future()

    def run() -> None:
        try:
            result.set_result(_registered(source))
        except BaseException as error:
            result.set_exception(error)

    threading.Thread(target=run, daemon=True).start()  # Python does not wait for it to exit
    return result


def _registered(source: str) -> str:
    begin = f"hybrid_jax_{_digest(source)}_"
    try:
        library = ctypes.CDLL(str(_checked_library(source)))
        for handler in ("forward", "backward")[: 1 + source.count("#define TRAINING 1")]:
            target = jax.ffi.pycapsule(ctypes.cast(library[handler], ctypes.c_void_p).value)
            jax.ffi.register_ffi_target(begin + handler, target, platform="cpu")
    except (OSError, AttributeError) as error:
        raise Unusable(f"its library could not be kept, or not be loaded: {error}") from error
    return begin


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
        watched, alone = ["sh", "-c", WATCHED, folder, *command], os.environ | {"TMPDIR": str(folder)}
        options = {"capture_output": True, "errors": "replace", "timeout": LONGEST, "start_new_session": True}
        subprocess.run(watched, check=True, stdin=inside, env=alone, **options)
    except subprocess.SubprocessError as error:
        said = [line for line in (getattr(error, "stderr", None) or "").splitlines() if "error" in line]
        raise Unusable(f"it could not be compiled: {(said or [f'{command[0]} fails'])[0]}") from error
    finally:
        os.close(inside)
        os.close(held)
