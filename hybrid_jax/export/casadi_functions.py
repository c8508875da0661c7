"""Fields and steps as CasADi functions, for optimal control, estimation and generated C code (extra `casadi`)."""

from typing import TYPE_CHECKING

import jax

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.export.program import OBSERVED, Size, program_of, sizes_of
from hybrid_jax.runtime import entry

if TYPE_CHECKING:
    import casadi

MOST_STATES = 512  # thousands, for example on a grid, would be a graph of millions of scalar operations


@entry
def casadi_function(
    field: AbstractVectorField,
    dt: float | None = None,
    *,
    state_size: Size = None,
    input_size: Size = None,
    name: str = "f",
    smooth: float | None = None,
    observe: bool = False,
) -> "casadi.Function":
    """Convert a field, or a step of it, to a CasADi function of x (d × 1) and u (m × 1), in double precision.

    The field is in inference mode, and the output is xdot, or xnext for a step. CasADi can differentiate the function,
    save it (`.save`) and translate it to C (`.generate`).

    Args:
        field: ẋ = f(x, u), for one state x (d,) and one input u (m,).
        dt: length of a step of RK4 with the input held [s], x⁺ = F(x, u); without it the function is ẋ.
        state_size: d; by default from the field's vehicle or its attribute of this name.
        input_size: m; by default from the field's vehicle or its attribute of this name.
        name: name of the CasADi function.
        smooth: β of ½ (z + √(z² + 1/β²)), which replaces the ReLU of networks (see `smoothed`). You should set it for
            solvers that use second derivatives, for example IPOPT.
        observe: return a function of x, u and `measured`, the sample dt after x, that returns the state there. You need
            it for a field from `fit_disturbance`, whose state you pass on; at first its filters should be zero.

    Raises:
        ValueError: if sizes are unknown, there are more than 512 states, the field does not accept such x and u, or
            CasADi does not have an operation.
        ImportError: if casadi is not installed.
    """
    try:
        import casadi as ca

        from hybrid_jax.export.casadi_operations import evaluate
    except ImportError as error:
        raise ImportError("CasADi functions need casadi: pip install 'hybrid_jax[casadi]'") from error
    if dt is not None or observe:
        checks.positive("dt", dt, "a positive number of seconds")
    sizes = sizes_of(field, state_size, input_size, observe)
    if sizes[0] > MOST_STATES:
        advice = "CasADi would write out every number; use export_program"
        raise ValueError(f"state_size must be at most {MOST_STATES}, got {sizes[0]}: {advice}")
    if not isinstance(name, str) or not ca.Function.check_name(name):
        raise ValueError(f"name must be a valid name of a CasADi function, got {checks.short_repr(name)}")
    names = list(OBSERVED[: len(sizes)])
    symbols = list(map(ca.SX.sym, names, sizes))
    # In double precision, so that the constants of the physics are not rounded.
    with jax.enable_x64(True):
        likes = [jax.ShapeDtypeStruct((size,), float) for size in sizes]
        result = evaluate(jax.make_jaxpr(program_of(field, likes, dt, smooth))(*likes), symbols)
    return ca.Function(name, symbols, [result], names, ["xdot" if dt is None else "xnext"])
