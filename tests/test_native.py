"""Compiled kernels are kept as long as somebody uses them."""

import os
import time
from pathlib import Path

import jax
import pytest

from hybrid_jax import native, runtime

LONG_AGO = time.time() - runtime.UNUSED - 3600

needs_kernels = pytest.mark.skipif(native.prefix() is None, reason=native.status())


def test_libraries_that_nobody_used_are_deleted_when_another_is_compiled(tmp_path, monkeypatch):
    monkeypatch.setattr(native, "_library", lambda: tmp_path / "native" / "this.so")
    monkeypatch.setattr(native.subprocess, "run", lambda command, **_: Path(command[-1]).write_bytes(b"compiled"))
    (tmp_path / "native").mkdir()
    for name in ("unused.so", "used.so", ".half.so.1.part"):
        (tmp_path / "native" / name).touch()
    for name in ("unused.so", ".half.so.1.part"):
        os.utime(tmp_path / "native" / name, (LONG_AGO, LONG_AGO))
    native._compile()
    assert {path.name for path in (tmp_path / "native").iterdir()} == {"this.so", "used.so"}


@needs_kernels
def test_a_library_that_is_loaded_counts_as_used(monkeypatch):
    monkeypatch.setattr(jax.ffi, "register_ffi_target", lambda *_, **__: None)  # XLA takes a name once
    os.utime(native._library(), (LONG_AGO, LONG_AGO))
    native._register()
    assert native._library().stat().st_mtime > LONG_AGO + 3600
