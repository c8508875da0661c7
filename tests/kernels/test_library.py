"""A library of kernels is kept as long as somebody uses it, and only one that is whole and one's own is loaded."""

import functools
import hashlib
import os
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.subjects import DT, untrained
from hybrid_jax import kernels, rollout_batch, runtime
from hybrid_jax.kernels import fields, library
from hybrid_jax.metrics import predict

LONG_AGO = time.time() - runtime.UNUSED - 3600
CONTENT, MACHINE = b"a library", runtime.machine()
needs_kernels = pytest.mark.skipif(library.obstacle() is not None, reason=kernels.status())


@pytest.fixture
def anew(monkeypatch):
    for function in (library.obstacle, library.begun):
        monkeypatch.setattr(library, function.__name__, functools.cache(function.__wrapped__))
    monkeypatch.setattr(fields, "_KNOWN", {})
    monkeypatch.setattr(fields, "UNSUPPORTED", {})
    monkeypatch.setattr(kernels, "obstacle", library.obstacle)
    monkeypatch.setattr(kernels, "UNSUPPORTED", fields.UNSUPPORTED)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder of libraries, where GCC needs no time."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    written = []

    def compiled(arguments):
        written.append(arguments[-1])
        with open(arguments[-1], "wb") as file:
            file.write(CONTENT)

    monkeypatch.setattr(library, "_run_compiler", compiled)
    return runtime.private_folder(library.FOLDER), written


def checked():
    return library._checked_library("int source;")


def test_a_library_is_compiled_once_and_whole_beside_its_checksum(cache):
    folder, written = cache
    path = checked()
    count = len(written)
    assert checked() == path
    assert len(written) == count > 0
    assert path.read_bytes() == CONTENT + hashlib.sha256(CONTENT).digest()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert [one.name for one in folder.iterdir()] == [path.name]


def test_a_killed_process_leaves_no_compiler_and_no_file(tmp_path):
    compiler, alive = tmp_path / "compiler", tmp_path / "alive"
    os.mkfifo(alive)
    compiler.write_text(f"#!/bin/sh\nexec 9>{alive}\ntouch $TMPDIR/part\nsleep 40\n")  # sleep is a child, as cc1plus
    compiler.chmod(0o700)
    code = "from hybrid_jax.kernels import library; library._checked_library('int source;')"
    environment = os.environ | {"CXX": str(compiler), "XDG_CACHE_HOME": str(tmp_path)}
    process = subprocess.Popen([sys.executable, "-c", code], env=environment)
    with alive.open() as held:  # once the compiler runs
        process.kill()
        process.wait()
        began = time.monotonic()
        held.read()  # until the last that holds it has ended
    assert time.monotonic() - began < 20
    while any((tmp_path / "hybrid_jax" / "kernels").iterdir()):
        assert time.monotonic() - began < 20
        time.sleep(0.02)


DAMAGES = {
    "cut in half": lambda path: path.write_bytes(path.read_bytes()[:4]),
    "empty": lambda path: path.write_bytes(b""),
    "one bit": lambda path: path.write_bytes(b"b" + path.read_bytes()[1:]),
    "no checksum": lambda path: path.write_bytes(CONTENT),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_library_is_compiled_anew(damage, cache):
    path = checked()
    damage(path)
    assert checked() == path
    assert path.read_bytes() == CONTENT + hashlib.sha256(CONTENT).digest()


def test_libraries_that_nobody_used_are_deleted_when_another_is_compiled(cache):
    folder, _ = cache
    for name in ("unused.so", "used.so", ".half.part"):
        (folder / name).touch()
    for name in ("unused.so", ".half.part"):
        os.utime(folder / name, (LONG_AGO, LONG_AGO))
    for name, age in (("left", 3 * library.LONGEST), ("at_work", 0)):  # folders in which somebody compiled, or does
        (folder / name).mkdir()
        os.utime(folder / name, (time.time() - age,) * 2)
    path = checked()
    (folder / "at_work").rmdir()
    assert {one.name for one in folder.iterdir()} == {path.name, "used.so"}
    os.utime(path, (LONG_AGO, LONG_AGO))
    assert checked().stat().st_mtime > LONG_AGO + 3600  # what is loaded counts as used


def test_what_others_can_write_is_neither_made_nor_used(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(runtime.PROGRAMS)
    before = os.umask(0)
    try:
        folders = [runtime.private_folder(name) for name in (library.FOLDER, "programs")]
    finally:
        os.umask(before)
    assert {each.stat().st_mode & 0o777 for each in (*folders, tmp_path / "cache" / "hybrid_jax")} == {0o700}
    for wrong, use in zip((*folders, folders[0].parent), (checked, runtime.configure, checked), strict=True):
        wrong.chmod(0o770)
        with pytest.raises((OSError, ValueError), match=f"others can write to {wrong}, which contains code; delete it"):
            use()
        wrong.chmod(0o700)
    monkeypatch.setattr(os, "getuid", lambda: 1 + folders[0].stat().st_uid)
    with pytest.raises(PermissionError, match="others can write"):
        checked()


def compiler_that(does):
    """A change that puts a compiler in the place of g++; "$last" is the file that it should write."""

    def change(tmp_path, monkeypatch):
        compiler = tmp_path / "compiler"
        compiler.write_text(f"#!/bin/sh\nfor last; do true; done\n{does}\n")
        compiler.chmod(0o700)
        monkeypatch.setenv("CXX", str(compiler))

    return change


def rejected(tmp_path, monkeypatch):
    monkeypatch.setattr(library, "OPTIONS", [*library.OPTIONS, "-Dfloat=none"])


WITHOUT = {
    "no AVX2": (lambda _, patch: patch.setattr(runtime, "machine", lambda: (*MACHINE[:-1], "sse4_2")), "no AVX2"),
    "switched off": (lambda _, patch: patch.setenv(library.SWITCH, "0"), "HYBRID_JAX_NATIVE is 0"),
    "no compiler": (lambda _, patch: patch.setenv("CXX", "no-such-compiler"), "no g++"),
    "a compiler that fails": (compiler_that("exit 1"), "could not be compiled"),
    "source that GCC rejects": (rejected, "could not be compiled: "),
    "a library that does not load": (compiler_that('echo no > "$last"'), "or loaded"),
    "a library without its functions": (compiler_that('g++ -shared -x c /dev/null -o "$last"'), "or loaded"),
    "no folder": (lambda path, _: (path / "hybrid_jax").touch(), "not be saved"),
}


@needs_kernels
@pytest.mark.parametrize(("change", "reason"), WITHOUT.values(), ids=WITHOUT)
def test_without_kernels_jax_does_the_same(change, reason, anew, tmp_path, monkeypatch):
    change(tmp_path, monkeypatch)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(library, "_entry", library._entry.__wrapped__)
    np.testing.assert_allclose(predicted().compile()(*ARGUMENTS), expected(), rtol=1e-6, atol=1e-6)
    assert reason in kernels.status()
    assert len(kernels.status().splitlines()) == 1
    assert not list(tmp_path.glob("*/*/*.so")) or "loaded" in reason


ARGUMENTS = untrained("physics_only"), jnp.ones((20, 13)) / 2, jnp.full((20, 2, 4), 500.0)


def expected():
    return jax.jit(rollout_batch)(*ARGUMENTS, DT)


def predicted():
    return jax.jit(lambda *arrays: predict(*arrays, DT)).lower(*ARGUMENTS)  # a function that is not traced yet


@needs_kernels
def test_gcc_works_while_jax_traces_and_compiles(anew, tmp_path, monkeypatch):
    compiler, compiled = library._run_compiler, threading.Event()

    def waiting(arguments):
        assert compiled.wait(60)
        compiler(arguments)

    monkeypatch.setattr(library, "_run_compiler", waiting)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    text = predicted()
    assert "custom_call @hybrid_jax_" in text.as_text()
    program = text.compile()
    compiled.set()
    np.testing.assert_allclose(program(*ARGUMENTS), expected(), rtol=1e-6, atol=1e-6)


@needs_kernels
def test_a_program_says_that_its_kernel_cannot_be_compiled(anew, tmp_path, monkeypatch):
    rejected(tmp_path, monkeypatch)  # not at the start, but later
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    said = r"could not be compiled: .*you can disable kernels with HYBRID_JAX_NATIVE=0"
    with pytest.raises(RuntimeError, match=said):
        np.asarray(predicted().compile()(*ARGUMENTS))
