"""Fields and steps as CasADi functions, for optimal control, estimation and generated C code (extra `casadi`)."""

from functools import partial
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.export.step import one_step
from hybrid_jax.integrate import Derivative, check_field
from hybrid_jax.state import INPUT_SIZE, STATE_SIZE

if TYPE_CHECKING:
    import casadi


def casadi_function(
    field: AbstractVectorField, *, state_size: int = STATE_SIZE, input_size: int = INPUT_SIZE, name: str = "f"
) -> "casadi.Function":
    """ẋ = f(x, u) of a field as deployed, from x (d × 1) and u (m × 1) to xdot (d × 1), in double precision.

    Any field of the library, and one of your own that is made of operations that CasADi has: its program is followed
    operation by operation, so that CasADi knows every entry and differentiates it. `.save`, `.generate` and the like
    are CasADi's own.

    Raises:
        ValueError: a field that does not take such x and u, or has an operation that CasADi has not; says which.
        ImportError: casadi is not installed.
    """
    return _function(field, lambda double: double, state_size, input_size, name, "xdot")


def casadi_step(
    field: AbstractVectorField,
    dt: float,
    *,
    state_size: int = STATE_SIZE,
    input_size: int = INPUT_SIZE,
    name: str = "F",
) -> "casadi.Function":
    """x⁺ = F(x, u), one step of the library's RK4 over dt [s] with u held; its output is xnext, else `casadi_function`.

    Raises:
        ValueError: dt that is not positive; as `casadi_function`.
        ImportError: casadi is not installed.
    """
    checks.positive("dt", dt, "a positive number of seconds")
    return _function(
        field, lambda double: partial(one_step, double, dt=float(dt)), state_size, input_size, name, "xnext"
    )


def _function(field, whole, state_size: int, input_size: int, name: str, output: str) -> "casadi.Function":
    try:
        import casadi as ca

        from hybrid_jax.export.casadi_operations import evaluate
    except ImportError as error:
        raise ImportError("CasADi functions need casadi: pip install 'hybrid_jax[casadi]'") from error
    checks.count("state_size", state_size)
    checks.count("input_size", input_size, least=0)
    if not isinstance(name, str) or not ca.Function.check_name(name):
        raise ValueError(f"name must be one that CasADi accepts for a function, got {checks.short_repr(name)}")
    symbols = [ca.SX.sym("x", state_size), ca.SX.sym("u", input_size)]
    # In double precision throughout: otherwise the constants of the physics would be rounded to single on the way.
    with jax.enable_x64(True):
        program = jax.make_jaxpr(whole(_double(field, state_size, input_size)))(*map(_like, (state_size, input_size)))
        result = evaluate(program, symbols)
    return ca.Function(name, symbols, [result], ["x", "u"], [output])


def _double(field, state_size: int, input_size: int) -> Derivative:
    double = jax.tree.map(lambda leaf: jnp.asarray(leaf, float) if eqx.is_inexact_array(leaf) else leaf, field)
    check_field(double, _like(state_size), _like(input_size))
    return double


def _like(size: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((size,), float)
