"""Fields and steps as C99 for a flight controller: one header, one source, no dependency but math.h, no allocation."""

import re
from collections.abc import Callable
from pathlib import Path
from string import Template

import jax
import jax.numpy as jnp

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, fuse_for_inference, linearize
from hybrid_jax.export.c.loops import Entry, Tables
from hybrid_jax.export.c.operations import CTranslation, column
from hybrid_jax.export.c.templates import HEADER, HELPERS, SOURCE
from hybrid_jax.export.program import Size, prepared, sizes_of, vehicle_in
from hybrid_jax.io.files import write_atomic
from hybrid_jax.state import STATE_NAMES


def export_c(
    folder: str | Path,
    field: AbstractVectorField,
    dt: float,
    *,
    name: str = "model",
    double: bool = False,
    smooth: float | None = None,
    state_size: Size = None,
    input_size: Size = None,
) -> tuple[Path, Path]:
    """Write NAME.h and NAME.c: ẋ = f(x, u) in inference mode, a step of RK4 over dt [s], and the Jacobians of both.

    The functions are NAME_derivative, NAME_step, NAME_derivative_jacobian and NAME_step_jacobian; the header says what
    they take. They are C99, use the stack alone, and may be called from several threads.

    Args:
        name: of the files and, as a prefix, of all that the header defines; a lower-case C identifier.
        double: compute in double precision, else in single.
        smooth: as of `casadi_function`.
        state_size: d; by default what the field knows (see `sizes_of`).
        input_size: m; likewise.

    Returns:
        The paths of the header and of the source.

    Raises:
        ValueError: unknown sizes, a field that does not accept such x and u, an operation that is not known in C, by
            its name, or a name that is no identifier.
        OSError: the folder cannot be written.
    """
    checks.positive("dt", dt, "a positive number of seconds")
    if (
        not isinstance(name, str) or not re.fullmatch("[a-z][a-z0-9_]*", name) or name == "math"
    ):  # math.h is the one header that it includes
        raise ValueError(f"name must be a lower-case C identifier, got {checks.short_repr(name)}")
    d, m = sizes_of(field, state_size, input_size)
    tables = Tables(double)
    # In double precision, so that constants are rounded once, when they are written.
    with jax.enable_x64(True):
        likes = [jax.ShapeDtypeStruct((size,), float) for size in (d, m)]
        fused = fuse_for_inference(prepared(field, likes, smooth))
        values = body_of(fused, likes, tables, ("xdot",))
        slopes = body_of(lambda x, u: _with_slopes(fused, x, u), likes, tables, ("xdot", "jacobian"))
    parts = {
        "name": name,
        "NAME": name.upper(),
        "type": "double" if double else "float",
        "d": d,
        "m": m,
        "dt": tables.text(float(dt)),
        "about": _about(vehicle_in(field) is not None, smooth),
        "values": values,
        "slopes": slopes,
    } | shared_by(tables, values, slopes)
    written = Path(folder) / f"{name}.h", Path(folder) / f"{name}.c"
    for path, template in zip(written, (HEADER, SOURCE), strict=True):
        write_atomic(path, Template(template).substitute(parts))
    return written


def _with_slopes(field: AbstractVectorField, x, u):
    """ẋ, and its Jacobian in x and u (d × (d + m))."""
    directions = jnp.eye(len(x) + len(u))
    return linearize(field, x, u, directions[: len(x)], directions[len(x) :])


def body_of(
    function: Callable, likes, tables: Tables, outputs: tuple[str, ...], inputs: tuple[str, ...] = ("x", "u")
) -> str:
    """The statements of a C function of some arrays, x and u by default, that fills others."""
    translation = CTranslation(tables)
    sizes = [like.shape[0] for like in likes]
    arguments = [column(Entry(name, i) for i in range(size)) for name, size in zip(inputs, sizes, strict=True)]
    results = translation.run(jax.make_jaxpr(function)(*likes), arguments, sizes)
    return translation.body(results, outputs)


def shared_by(tables: Tables, *bodies: str) -> dict[str, str]:
    """The tables and functions that bodies of functions use."""
    words = set(re.findall(r"\w+", "\n".join([*tables.functions, *bodies])))
    return {
        "tables": "\n".join(text for key, text in tables.definitions.items() if key in words),
        "helpers": "\n".join([*(text for key, text in HELPERS.items() if key in words), *tables.functions]),
    }


def _about(is_multirotor: bool, smooth: float | None) -> str:
    """What x and u are, as lines of a comment."""
    lines = []
    if is_multirotor:
        lines = [
            f"x: {', '.join(STATE_NAMES)}:",
            "   position [m] and velocity [m/s] in the world frame, z up; unit quaternion w, x, y, z, body to world;",
            "   angular velocity [rad/s] in the body frame, x forward, y left, z up.",
            "u: the rotors' speeds [rad/s], in the order of the vehicle's rotor_positions.",
        ]
    if smooth is not None:
        lines.append(f"ReLU z is replaced by (z + sqrt(z*z + 1/b^2))/2, b = {smooth:g}.")
    return "".join(f"\n   {line}" for line in lines)
