"""Fields and steps as CasADi functions, for optimal control, estimation and generated C code (extra `casadi`)."""

from typing import TYPE_CHECKING

import jax

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.export.program import Size, program_of, sizes_of

if TYPE_CHECKING:
    import casadi


def casadi_function(
    field: AbstractVectorField, *, state_size: Size = None, input_size: Size = None, name: str = "f"
) -> "casadi.Function":
    """ẋ = f(x, u) of a field in inference mode, from x (d × 1) and u (m × 1) to xdot (d × 1), in double precision.

    CasADi differentiates it, saves it (`.save`) and translates it to C (`.generate`).

    Args:
        state_size: d; by default what the field knows (see `sizes_of`).
        input_size: m; likewise.

    Raises:
        ValueError: unknown sizes, a field that does not accept such x and u, or an operation that CasADi does not
            have, by its name.
        ImportError: casadi is not installed.
    """
    return _function(field, None, state_size, input_size, name, "xdot")


def casadi_step(
    field: AbstractVectorField, dt: float, *, state_size: Size = None, input_size: Size = None, name: str = "F"
) -> "casadi.Function":
    """x⁺ = F(x, u), one step of RK4 over dt [s] with u held; its output is xnext. Otherwise as `casadi_function`."""
    checks.positive("dt", dt, "a positive number of seconds")
    return _function(field, float(dt), state_size, input_size, name, "xnext")


def _function(field, dt: float | None, state_size: Size, input_size: Size, name: str, output: str) -> "casadi.Function":
    try:
        import casadi as ca

        from hybrid_jax.export.casadi_operations import evaluate
    except ImportError as error:
        raise ImportError("CasADi functions need casadi: pip install 'hybrid_jax[casadi]'") from error
    sizes = sizes_of(field, state_size, input_size)
    if not isinstance(name, str) or not ca.Function.check_name(name):
        raise ValueError(f"name must be one that CasADi accepts for a function, got {checks.short_repr(name)}")
    symbols = [ca.SX.sym("x", sizes[0]), ca.SX.sym("u", sizes[1])]
    # In double precision throughout, so that the constants of the physics are not rounded.
    with jax.enable_x64(True):
        likes = [jax.ShapeDtypeStruct((size,), float) for size in sizes]
        result = evaluate(jax.make_jaxpr(program_of(field, likes, dt))(*likes), symbols)
    return ca.Function(name, symbols, [result], ["x", "u"], [output])
