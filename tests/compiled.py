"""C that `export_c` wrote, compiled without a warning and called from Python."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest

WARNINGS = ("-Wall", "-Wextra", "-Werror", "-pedantic", "-Wdouble-promotion", "-Wfloat-conversion", "-Wshadow")
C99 = ("-std=c99", *WARNINGS)
needs_compiler = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")


def run(*command, **options) -> str:
    """What a command prints, once it has ended well."""
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=120, **options)
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
    return done.stdout


class Library:
    """The functions of NAME.h on arrays; each result is an array of its own."""

    def __init__(self, source, sizes, double, optimise="-O1"):
        library = source.with_suffix(".so")
        run("gcc", *C99, optimise, "-fPIC", "-shared", source, "-o", library, "-lm")
        self._library, self._name, (self.d, self.m) = ctypes.CDLL(str(library)), source.stem, sizes
        self.dtype = np.dtype(np.float64 if double else np.float32)

    def __call__(self, function, *given):
        """What NAME_function writes: a vector, and with Jacobians the matrices by x and by u."""
        shapes = [(self.d,)] + [(self.d, self.d), (self.d, self.m)] * function.endswith("jacobian")
        results = [np.full(shape, np.nan, self.dtype) for shape in shapes]
        arguments = [np.ascontiguousarray(a, self.dtype) for a in given]
        places = (a.ctypes.data_as(ctypes.c_void_p) for a in (*arguments, *results))
        getattr(self._library, f"{self._name}_{function}")(*places)
        return results if len(results) > 1 else results[0]
