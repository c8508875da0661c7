"""Fields and steps as CasADi functions, for optimal control, estimation and generated C code (extra `casadi`)."""

from functools import partial
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.export.sizes import sizes_of
from hybrid_jax.integrate import Derivative, check_field, rk4_step

if TYPE_CHECKING:
    import casadi


def casadi_function(
    field: AbstractVectorField, *, state_size: int | None = None, input_size: int | None = None, name: str = "f"
) -> "casadi.Function":
    """ẋ = f(x, u) of a field in inference mode, from x (d × 1) and u (m × 1) to xdot (d × 1), in double precision.

    The field's program is translated operation by operation into symbolic expressions, which CasADi differentiates,
    saves (`.save`) and translates to C (`.generate`).

    Args:
        field: any field of the library, or a custom one made of operations that CasADi has.
        state_size: d; by default what the field knows (see `sizes_of`).
        input_size: m; likewise.
        name: of the function.

    Raises:
        ValueError: unknown sizes, a field that does not accept such x and u, or an operation that CasADi does not
            have, by its name.
        ImportError: casadi is not installed.
    """
    return _function(field, lambda double: double, state_size, input_size, name, "xdot")


def casadi_step(
    field: AbstractVectorField,
    dt: float,
    *,
    state_size: int | None = None,
    input_size: int | None = None,
    name: str = "F",
) -> "casadi.Function":
    """x⁺ = F(x, u), one step of RK4 over dt [s] with u held; its output is xnext. Otherwise as `casadi_function`.

    Raises:
        ValueError: dt is not positive; and as `casadi_function`.
        ImportError: casadi is not installed.
    """
    checks.positive("dt", dt, "a positive number of seconds")
    return _function(
        field, lambda double: partial(rk4_step, double, dt=float(dt)), state_size, input_size, name, "xnext"
    )


def _function(
    field, whole, state_size: int | None, input_size: int | None, name: str, output: str
) -> "casadi.Function":
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
        program = jax.make_jaxpr(whole(_double(field, *sizes)))(*map(_like, sizes))
        result = evaluate(program, symbols)
    return ca.Function(name, symbols, [result], ["x", "u"], [output])


def _double(field, state_size: int, input_size: int) -> Derivative:
    double = jax.tree.map(lambda leaf: jnp.asarray(leaf, float) if eqx.is_inexact_array(leaf) else leaf, field)
    check_field(double, _like(state_size), _like(input_size))
    return double


def _like(size: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((size,), float)
