"""Fields and steps as StableHLO programs in files, by `jax.export`, which JAX can run without this library."""

import importlib.util
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.export.program import program_of, sizes_of
from hybrid_jax.io.files import load_archive, save_archive
from hybrid_jax.runtime import entry

FORMAT = "hybrid_jax program 1"
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
BATCH = "b"  # name of the batch axis, whose length is symbolic


@dataclass(frozen=True)
class Program:
    """ẋ = f(x, u), or x⁺ = F(x, u), read from a file. You can use it under `jax.jit`, not `jax.vmap` or `jax.grad`.

    Attributes:
        dt: length of a step [s]; None for a field.
        state_size: d.
        input_size: m.
        measured_size: n, for a program with `observe`; else 0.
        batched: whether it takes x (b, d) and u (b, m), for any b of at least 1; else x (d,) and u (m,).
        platforms: the platforms that can run it, for example "cpu".
        about: JSON values that describe the model.
    """

    dt: float | None
    state_size: int
    input_size: int
    measured_size: int
    batched: bool
    platforms: tuple[str, ...]
    about: Mapping[str, Any]
    _call: Callable[..., Array] = field(repr=False)

    def __call__(
        self,
        x: Float[Array | np.ndarray, "*b d"],
        u: Float[Array | np.ndarray, "*b m"],
        measured: Float[Array | np.ndarray, "*b n"] | None = None,
    ) -> Float[Array, "*b d"]:
        """Return ẋ, or the state dt later with the input held, in single precision; ValueError for other arrays.

        Args:
            x: state (d,), or states (b, d).
            u: input (m,), or inputs (b, m).
            measured: the sample dt later (n,), or (b, n), for a program with `observe`.
        """
        sizes = {"x": self.state_size, "u": self.input_size}
        sizes |= {"measured": self.measured_size} if self.measured_size else {}
        given = [value for value in (x, u, measured) if value is not None]
        arrays = [checks.floating(name, one).astype(jnp.float32) for name, one in zip(sizes, given, strict=False)]
        batch = arrays[0].shape[:1] if self.batched else ()
        shapes = [one.shape for one in arrays]
        if len(given) > len(sizes) or shapes != [(*batch, size) for size in sizes.values()] or 0 in batch:
            form = "{} (b, {})" if self.batched else "{} ({},)"
            expected = " and ".join(form.format(*each) for each in sizes.items())
            raise ValueError(f"{expected} expected, got shapes {' and '.join(map(str, shapes))}")
        return self._call(*arrays)


@entry
def export_program(
    path: str | Path,
    field: AbstractVectorField,
    dt: float | None = None,
    *,
    state_size: int | None = None,
    input_size: int | None = None,
    batched: bool = False,
    platforms: tuple[str, ...] = ("cpu",),
    smooth: float | None = None,
    observe: bool = False,
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write a field, or a step of it, in inference mode and single precision, to a file for `load_program`.

    Args:
        path: the file to write, an archive with the bytes of `jax.export.Exported.serialize`.
        field: ẋ = f(x, u), for one state x (d,) and one input u (m,).
        dt: length of a step of RK4 with the input held [s], x⁺ = F(x, u); without it ẋ is written.
        state_size: d; by default from the field's vehicle or its attribute of this name.
        input_size: m; by default from the field's vehicle or its attribute of this name.
        batched: take x (b, d) and u (b, m), for any b of at least 1; else x (d,) and u (m,).
        platforms: the platforms to export for, from PLATFORMS. You should list only a few: each makes the file longer.
        smooth: see `casadi_function`.
        observe: see `casadi_function`.
        about: JSON values to store with the program.

    Raises:
        ValueError: if sizes or a platform are unknown, the field does not accept such x and u, `about` is not JSON, or
            the program has an external call, for example to LAPACK.
        ImportError: if flatbuffers is not installed (extra `export`).
        OSError: if the folder cannot be written.
    """
    if dt is not None or observe:
        checks.positive("dt", dt, "a positive number of seconds")
        dt = float(dt)  # pyright: ignore[reportArgumentType]
    _need_flatbuffers()
    sizes = sizes_of(field, state_size, input_size, observe)
    if not isinstance(platforms, tuple) or not platforms or any(one not in PLATFORMS for one in platforms):
        known = ", ".join(PLATFORMS)
        raise ValueError(f"platforms must be a tuple of some of {known}, got {checks.short_repr(platforms)}")
    with jax.enable_x64(False), _without_source_locations():
        likes = [jax.ShapeDtypeStruct((size,), jnp.float32) for size in sizes]
        program = program_of(field, likes, dt, smooth, batched)
        batch = jax.export.symbolic_shape(BATCH) if batched else ()
        rows = (jax.ShapeDtypeStruct((*batch, size), jnp.float32) for size in sizes)
        exported = jax.export.export(jax.jit(program), platforms=platforms)(*rows)
    _check_calls(exported)
    metadata = {"dt": dt, "about": dict(about or {})}
    save_archive(path, FORMAT, metadata, {"exported": np.frombuffer(exported.serialize(), np.uint8)})


def load_program(path: str | Path) -> Program:
    """Read a file of `export_program`. A file cannot run any Python code.

    Args:
        path: the file to read.

    Raises:
        ValueError: if the file is missing, damaged, not a program, or has an external call.
        ImportError: if flatbuffers is not installed (extra `export`).
    """
    _need_flatbuffers()
    metadata, arrays = load_archive(path, FORMAT)
    try:
        exported = jax.export.deserialize(bytearray(arrays["exported"].tobytes()))
        _check_calls(exported)
        dt, about = metadata["dt"], dict(metadata["about"])
        if dt is not None:
            checks.positive("dt", dt)
        batched, state_size, input_size, measured = _sizes(exported)
    except Exception as error:  # JAX's parser raises errors of any type
        raise ValueError(f"{path}: not a program of a field or a step: {checks.first_line(error)}") from error
    sizes = state_size, input_size, measured, batched
    return Program(dt, *sizes, exported.platforms, about, jax.jit(exported.call))


@contextmanager
def _without_source_locations() -> Iterator[None]:
    """Omit the paths and lines of the traced source from programs."""
    before = jax.config.jax_traceback_in_locations_limit  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_traceback_in_locations_limit", 0)
    try:
        yield
    finally:
        jax.config.update("jax_traceback_in_locations_limit", before)


def _check_calls(exported: jax.export.Exported) -> None:
    """Raise ValueError for a program with external calls, which would depend on the machine's libraries."""
    for call in re.findall(r"custom_call\W*(\w*)", exported.mlir_module()):
        if call != "shape_assertion":  # JAX's check of a symbolic length
            raise ValueError(f"field: its program calls {call or 'something'}, which is not an operation of StableHLO")


def _sizes(exported: jax.export.Exported) -> tuple[bool, int, int, int]:
    (x, u, *rest), (result,) = exported.in_avals, exported.out_avals
    batched, given = len(x.shape) == 2, (x, u, *rest[:1])
    d, m, *n = (value.shape[-1] for value in given)
    batch = (BATCH,) if batched else ()
    shapes = [tuple(map(str, value.shape)) for value in (*given, result)]
    fits = shapes == [(*batch, str(size)) for size in (d, m, *n, d)]
    single = all(value.dtype == np.float32 for value in (*given, result))
    trees = (exported.in_tree, exported.out_tree) == tuple(map(jax.tree.structure, (((0,) * len(given), {}), 0)))
    if not (fits and single and trees):
        raise ValueError(f"the program must map float32 x, u to an x, not {exported.in_avals} to {exported.out_avals}")
    return batched, int(d), int(m), int(n[0]) if n else 0


def _need_flatbuffers() -> None:
    if importlib.util.find_spec("flatbuffers") is None:
        raise ImportError("programs in files need flatbuffers: pip install 'hybrid_jax[export]'")
