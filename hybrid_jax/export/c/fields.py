"""Fields and steps as C99 for a flight controller."""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, as_field
from hybrid_jax.dynamics.hidden import DisturbanceModel
from hybrid_jax.dynamics.rigid_body import vehicle_in
from hybrid_jax.export.c.files import CFile
from hybrid_jax.export.program import OBSERVED, Size, prepared, program_of, sizes_of
from hybrid_jax.runtime import entry
from hybrid_jax.vehicle import STATE_NAMES

ABOUT = """\
A model dx/dt = f(x, u), written by hybrid_jax.
{}

   Matrices are in row-major order: dx[i][j] is the derivative of entry i of the result by x[j].
   No function allocates, keeps a state or changes what it reads; results must not overlap what is read.
   If x or u is not finite, the result is not finite either: you should test it."""
STEP = """\
The state after a step from x with constant u, by the classical Runge-Kutta method of order 4.
   Quaternions are not normalised."""
OBSERVE = """\
The state after a step from x with constant u, where its first {} numbers were measured. The last {} are filtered errors
   of the model. They should be 0 at the first sample, and then what this function returns."""


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
    there is also NAME_observe, which returns the state after each sample, for you to pass on.

    Args:
        folder: where the files are written; it is created if it does not exist.
        field: ẋ = f(x, u), for one state x (d,) and one input u (m,).
        dt: length of a step [s].
        name: name of the files and prefix of all definitions. It should be a lower-case C identifier.
        double: compute in double instead of single precision.
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
    file, (d, m) = CFile(name, double), sizes_of(field, state_size, input_size)
    inputs, jacobians = {"x": (d,), "u": (m,)}, ("dx", "du")
    # In double precision, so that constants are rounded once, when they are written.
    with jax.enable_x64(True):
        likes = [jax.ShapeDtypeStruct(shape, float) for shape in inputs.values()]
        fused = as_field(prepared(field, likes, smooth)).fuse_for_inference()
        eye = jnp.eye(d + m)

        def linearized(x, u):
            slope, columns = as_field(fused).linearize(x, u, eye[:d], eye[d:])
            return [slope, *jnp.split(columns, [d], axis=1)]

        derivative = file.add("derivative", "dx/dt at the state x under the input u.", fused, inputs, ["xdot"])
        file.add("step", STEP, lambda x, u: _step(derivative, x, u, dt), inputs, ["next"])
        about, slopes = "Like derivative, with its Jacobians.", ["xdot", *jacobians]
        linearize = file.add("derivative_jacobian", about, linearized, inputs, slopes)

        def along(state, u):  # the state, and its derivatives by the start of the step and by u
            slope, dx, du = linearize(state[0], u)
            return slope, dx @ state[1], dx @ state[2] + du

        def step_jacobian(x, u):
            return _step(along, (x, jnp.eye(d), jnp.zeros((d, m))), u, dt)

        file.add("step_jacobian", "Like step, with its Jacobians.", step_jacobian, inputs, ["next", *jacobians])
        if isinstance(field, DisturbanceModel):
            shapes = inputs | {OBSERVED[-1]: (d - field.hidden,)}
            likes = [jax.ShapeDtypeStruct(shape, float) for shape in shapes.values()]
            about = OBSERVE.format(d - field.hidden, field.hidden)
            file.add("observe", about, program_of(field, likes, dt, smooth), shapes, ["next"])
    constants = [
        f"STATE_SIZE {d}",
        f"INPUT_SIZE {m}",
        f"DT {file.printer.number(float(dt))} /* length of a step [s] */",
    ]
    return file.write(folder, ABOUT.format(_about(vehicle_in(field) is not None, smooth)), constants)


def _step(derivative: Callable, start, u, dt: float):
    """Make a step of RK4 from a tree of arrays, as a loop over its stages with one call of the derivative."""

    def moved(start, factor, slope):
        return jax.tree.map(lambda a, b: a + factor * b, start, slope)

    def stage(carried, factors):
        slope, total = carried
        slope = derivative(moved(start, factors[0], slope), u)
        return (slope, moved(total, factors[1], slope)), None

    none, factors = jax.tree.map(jnp.zeros_like, start), jnp.array([[0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1, 1 / 6]])
    return jax.lax.scan(stage, (none, start), dt * factors)[0][1]


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
