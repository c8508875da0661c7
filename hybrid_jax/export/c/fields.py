"""Fields and steps as C99 for a flight controller: one header, one source, no dependency but math.h, no allocation."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from string import Template
from typing import Any

import jax
import jax.numpy as jnp

from hybrid_jax import checks
from hybrid_jax.codegen.loops import Tables
from hybrid_jax.codegen.nodes import Entry, Statement
from hybrid_jax.codegen.operations import CTranslation, column
from hybrid_jax.codegen.printer import CPrinter
from hybrid_jax.codegen.translation import Entries
from hybrid_jax.dynamics.base import AbstractVectorField, as_field
from hybrid_jax.dynamics.hidden import DisturbanceModel
from hybrid_jax.export.c.templates import HEADER, OBSERVE, PAST_HEADER, SOURCE
from hybrid_jax.export.program import OBSERVED, Size, prepared, program_of, sizes_of, vehicle_in
from hybrid_jax.io.files import write_atomic
from hybrid_jax.runtime import entry
from hybrid_jax.vehicle import STATE_NAMES


@entry
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
    """Write a field in inference mode as C99: ẋ = f(x, u), a step of RK4 over dt [s], and the Jacobians of both.

    NAME.c has NAME_derivative, NAME_step, NAME_derivative_jacobian and NAME_step_jacobian, and NAME.h describes their
    arguments. They use only the stack, and you can call them from several threads. For a field from `fit_disturbance`
    there is NAME_observe, too, which returns the state that you carry after each sample.

    Args:
        folder: where the files are written; it is created if it does not exist.
        field: ẋ = f(x, u), for one state x (d,) and one input u (m,).
        dt: length of a step [s].
        name: name of the files and prefix of all definitions in the header; a lower-case C identifier.
        double: compute in double precision, else in single.
        smooth: see `casadi_function`.
        state_size: d; by default from the field's vehicle or its attribute of this name.
        input_size: m; by default from the field's vehicle or its attribute of this name.

    Returns:
        The paths of the header and of the source.

    Raises:
        ValueError: if sizes are unknown, the field does not accept such x and u, an operation has no C code, or the
            name is not an identifier.
        OSError: if the folder cannot be written.
    """
    checks.positive("dt", dt, "a positive number of seconds")
    check_name(name)
    d, m = sizes_of(field, state_size, input_size)
    tables, printer = Tables(double), CPrinter(double)
    # In double precision, so that constants are rounded once, when they are written.
    with jax.enable_x64(True):
        likes = [jax.ShapeDtypeStruct((size,), float) for size in (d, m)]
        fused = as_field(prepared(field, likes, smooth)).fuse_for_inference()
        values = body_of(fused, likes, tables, ("xdot",))
        directions = jnp.split(jnp.eye(d + m), [d])
        slopes = body_of(lambda x, u: as_field(fused).linearize(x, u, *directions), likes, tables, ("xdot", "jacobian"))
        bodies, parts, header, source = {"values": values, "slopes": slopes}, {}, HEADER, SOURCE
        if isinstance(field, DisturbanceModel):
            header, source, parts = PAST_HEADER, SOURCE + OBSERVE, {"n": d - field.hidden, "hidden": field.hidden}
            likes.append(jax.ShapeDtypeStruct((parts["n"],), float))
            bodies["observe"] = body_of(program_of(field, likes, dt, smooth), likes, tables, ("next",), OBSERVED)
    about = _about(vehicle_in(field) is not None, smooth)
    parts |= {"d": d, "m": m, "dt": printer.number(float(dt)), "about": about}
    return written(folder, name, header, source, parts | printer.parts(tables, **bodies))


def check_name(name: str) -> None:
    # math.h is the one header that a source includes.
    if not isinstance(name, str) or not re.fullmatch("[a-z][a-z0-9_]*", name) or name == "math":
        raise ValueError(f"name must be a lower-case C identifier, got {checks.short_repr(name)}")


def written(folder: str | Path, name: str, header: str, source: str, parts: Mapping[str, Any]) -> tuple[Path, Path]:
    paths = Path(folder) / f"{name}.h", Path(folder) / f"{name}.c"
    for path, template in zip(paths, (header, source), strict=True):
        write_atomic(path, Template(template).substitute(parts, name=name, NAME=name.upper()))
    return paths


def body_of(
    function: Callable, likes, tables: Tables, outputs: tuple[str, ...], inputs: tuple[str, ...] = ("x", "u")
) -> tuple[Statement, ...]:
    """Return the statements of a C function from arrays, by default x and u, to output arrays."""
    translation = CTranslation(tables)
    pairs = zip(inputs, likes, strict=True)
    arguments = [Entries(column(Entry(name, i) for i in range(like.size)), like.shape) for name, like in pairs]
    results = translation.run(jax.make_jaxpr(function)(*likes), arguments)
    return translation.body(results, outputs)


def _about(is_multirotor: bool, smooth: float | None) -> str:
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
