"""Integrate a vector field with piecewise constant inputs, by any one-step ODE solver of diffrax."""

from collections.abc import Callable
from functools import partial
from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, as_field, state_space
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.implicit_solvers import prepared
from hybrid_jax.runtime import entry, jit_by_size

Derivative = Callable[[Float[Array, " d *b"], Float[Array, " m *b"]], Float[Array, " d *b"]]
Solver = diffrax.AbstractSolver
LONG = 1000  # intervals after which the norm of a quaternion has drifted by more than rounding

# Traced once for all stages of a step; the compiler inlines it again.
_infer = jit_by_size()(lambda field, x, u: as_field(field).infer_batch(x, u))


class RK4(diffrax.AbstractSolver):
    """The classical fourth-order Runge–Kutta method (Kutta 1901) with fixed steps, as a solver of diffrax.

    Attributes:
        scanned: whether its stages are a loop, which compiles faster (see `compact`). The result is the same.
        substeps: number of steps in each interval. You should use more if one is inaccurate, for example if stiff.
    """

    scanned: bool = False
    substeps: int = 1
    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def __check_init__(self):
        checks.count("substeps", self.substeps)

    def order(self, terms):
        return 4

    def init(self, terms, t0, t1, y0, args):
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        half = (t1 - t0) / 2
        middle = t0 + half
        if self.scanned:
            times, steps = jnp.array([t0, middle, middle, t1]), jnp.array([0, half, half, 2 * half], y0.dtype)

            def stage(before, node):  # the slope after a step along the slope before
                slope = terms.vf(node[0], y0 + node[1] * before, args)
                return slope, slope

            # The first step is 0, so that any slope will do.
            k1, k2, k3, k4 = jax.lax.scan(stage, y0, (times, steps))[1]
        else:
            k1 = terms.vf(t0, y0, args)
            k2 = terms.vf(middle, y0 + half * k1, args)
            k3 = terms.vf(middle, y0 + half * k2, args)
            k4 = terms.vf(t1, y0 + 2 * half * k3, args)
        y1 = y0 + (half / 3) * (k1 + 2 * (k2 + k3) + k4)
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


def compact(solver: Solver | None) -> Solver:
    """Return the solver, by default RK4, with its stages in a loop. It compiles faster; use it for what runs rarely."""
    if solver is None or isinstance(solver, RK4):
        return RK4(scanned=True, substeps=1 if solver is None else solver.substeps)
    return solver


def integrate(
    derivative: Derivative,
    x0: Float[Array, " d *b"],
    u: Float[Array, "t m *b"],
    dt: float,
    solver: Solver,
    substeps=1,
    project: Callable[[Array], Array] = lambda x: x,
) -> Float[Array, "t d *b"]:
    """Return the states at the end of each of t intervals of length dt [s], each passed through `project`.

    Each interval is a separate solve with its input as `args`. A single solve would use the next input at its end.
    """
    solver = prepared(solver, jnp.result_type(x0))
    term = diffrax.ODETerm(lambda t, x, args: derivative(x, args[0]))
    substeps *= solver.substeps if isinstance(solver, RK4) else 1
    begin, end = 0.0, dt / substeps
    if implicit := isinstance(solver, diffrax.AbstractImplicitSolver):
        begin, end = jnp.asarray(begin, x0.dtype), jnp.asarray(end, x0.dtype)  # its root finder needs arrays

    def interval(x, held):
        # The input has jumped, so the solver may not reuse anything from the last interval.
        started = x, solver.init(term, begin, end, x, (held, x))

        def step(carry, _):
            x, state = carry
            known = jnp.isfinite(x).all() if implicit else True
            x = jnp.where(known, x, x0) if implicit else x  # a later step must be differentiable
            x, _, _, state, result = solver.step(term, begin, end, x, (held, x), state, made_jump=False)
            solved = known & (result == diffrax.RESULTS.successful)
            return (jnp.where(solved, x, jnp.nan) if implicit else x, state), None

        # One step, as in training, needs no loop. Many steps, written out, would take minutes to compile.
        (x, _), _ = step(started, None) if substeps == 1 else jax.lax.scan(step, started, length=substeps)
        return (x := project(x)), x

    return jax.lax.scan(interval, x0, u)[1]


def rk4_step(
    derivative: Derivative, x: Float[Array, " d *b"], u: Float[Array, " m *b"], dt: float
) -> Float[Array, " d *b"]:
    """Return the state after one RK4 step of dt [s] with constant input, as in an interval of `rollout`."""
    evaluate = traced_once(derivative, x)
    term = diffrax.ODETerm(lambda t, x, held: evaluate(x, held))
    return RK4().step(term, 0.0, dt, x, u, None, made_jump=False)[0]


def traced_once(derivative: Derivative, x: Float[Array, " d *b"]) -> Derivative:
    """Return the derivative, traced once for all stages of a step from x."""
    if isinstance(derivative, AbstractVectorField):
        return partial(_evaluate, derivative)
    # Outside of compiled code, this new function would be compiled at every call.
    return jax.jit(lambda x, held: derivative(x, held)) if checks.is_traced(x) else derivative


@jit_by_size()
def _evaluate(field: AbstractVectorField, x, u):
    return field(x, u)


@entry
def rollout(
    field: AbstractVectorField,
    x0: Float[Array | np.ndarray, " d"],
    u: Float[Array | np.ndarray, "t m"],
    dt: float,
    solver: Solver | None = None,
) -> Float[Array, "t d"]:
    """Integrate a field in inference mode: x[i] is the state (i + 1) dt after x0, and u[i] the input before it.

    A trajectory continues as infinity or NaN if it diverges, or if an implicit solver finds no step. If you want an
    error instead, you should use `Model.predict`. For more than 1000 intervals, attitudes are normalised after each.

    Args:
        field: ẋ = f(x, u), a vector field or any function of a state (d,) and an input (m,).
        x0: the initial state (d,).
        dt: length of an interval [s].
        solver: a one-step ODE solver of diffrax; by default `RK4`. For a long dt, it should be `RK4(substeps=4)` or so.

    Raises:
        ValueError: an argument has the wrong shape or type, or is not finite; dt is not positive; the solver is
            not for ODEs; or the field does not map x0 and u to ẋ of the shape of x0.
    """
    return _integrate(field, *checked(field, x0, u, dt, solver), dt)


@jit_by_size()
def _integrate(field, x0, u, solver, dt):
    return integrate(field, x0, u, dt, solver, 1, projection(field, len(x0), len(u)))


def projection(field, d: int, intervals: int) -> Callable[[Array], Array]:
    """Return the map for states after each interval: onto their manifold beyond `LONG` intervals, else the identity."""
    return state_space(field, d).projected if intervals > LONG else lambda x: x


@entry
def rollout_batch(
    field: AbstractVectorField,
    x0: Float[Array | np.ndarray, "n d"],
    u: Float[Array | np.ndarray, "n t m"],
    dt: float,
    solver: Solver | None = None,
) -> Float[Array, "n t d"]:
    """Integrate a field over each of n windows; see `rollout`.

    Args:
        field: ẋ = f(x, u); see `rollout`.
        x0: the initial state of each window (n, d).
        dt: length of an interval [s].
        solver: by default `RK4`.
    """
    return _integrate_batch(field, *checked(field, x0, u, dt, solver, windows=True), dt)


@jit_by_size()
def _integrate_batch(field, x0, u, solver, dt):
    if isinstance(solver, diffrax.AbstractImplicitSolver) or not as_field(field).features_first:
        return jax.vmap(lambda start, held: _integrate(field, start, held, solver, dt))(x0, u)
    project = jax.vmap(projection(field, x0.shape[1], u.shape[1]), -1, -1)
    columns, held = jnp.moveaxis(x0, 0, -1), jnp.moveaxis(u, 0, -1)
    states = integrate(lambda x, held: _infer(field, x, held), columns, held, dt, solver, 1, project)
    return jnp.moveaxis(states, -1, 0)


def checked(
    field, x0, u, dt, solver, *, windows: bool = False
) -> tuple[Float[Array, "*n d"], Float[Array, "*n t m"], Solver]:
    """Check the arguments of `rollout`; return x0 in the precision of ẋ, u, and the solver or its default."""
    x0, u = checks.floating("x0", x0), checks.floating("u", u)
    expected = "x0 (n, d) and u (n, t, m)" if windows else "x0 (d,) and u (t, m)"
    if x0.ndim != 1 + windows or u.ndim != x0.ndim + 1 or u.shape[:-2] != x0.shape[:-1]:
        raise ValueError(f"{expected} expected, got shapes {x0.shape} and {u.shape}")
    checks.positive("dt", dt, "a positive number of seconds")
    solver = RK4() if solver is None else solver
    check_solver(solver)
    slope = check_field(field, *(jax.ShapeDtypeStruct(part.shape[-1:], part.dtype) for part in (x0, u)))
    return x0.astype(jnp.result_type(x0.dtype, slope.dtype)), u, solver


def check_solver(solver) -> None:
    if not isinstance(solver, diffrax.AbstractSolver):
        raise ValueError(f"solver must be one of diffrax or of hybrid_jax.SOLVERS, got {checks.short_repr(solver)}")
    # Each step starts at time zero, so a multistep method would remember wrong times.
    if solver.term_structure is not diffrax.AbstractTerm or isinstance(solver, diffrax.LeapfrogMidpoint):
        raise ValueError(f"solver must be a one-step method for ODEs of one term, got {type(solver).__name__}")


def check_callable(field) -> None:
    """Require a field; a result that contains one is an error."""
    if not callable(field):
        inside = next((f"; pass its .{part}" for part in ("best", "field") if callable(getattr(field, part, None))), "")
        raise ValueError(f"field: must be a function (x, u) → ẋ, got {type(field).__name__}{inside}")


def check_field(field, x: Array | jax.ShapeDtypeStruct, u: Array | jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    """Return shape and type of ẋ = field(x, u); ValueError if it does not have the shape of x."""
    check_callable(field)
    name = getattr(field, "__name__", type(field).__name__)
    given = f"a state {x.shape} and an input {u.shape}"
    try:
        slope = eqx.filter_eval_shape(field, x, u)
    except Exception as error:  # a user's code may raise anything
        for part in (field.physics, field.residual) if isinstance(field, Hybrid) else ():
            check_field(part, x, u)  # names the part that does not accept them
        reason = f"{type(error).__name__}: {checks.first_line(error)}"
        raise ValueError(f"field: {name} does not accept {given}: {reason}") from error
    if getattr(slope, "shape", None) != x.shape or not jnp.issubdtype(slope.dtype, jnp.floating):
        found = f"{slope.dtype}{list(slope.shape)}" if hasattr(slope, "shape") else type(slope).__name__
        raise ValueError(f"field: {name} must return a derivative {x.shape} for {given}, returned {found}")
    return slope


SOLVERS: dict[str, Solver] = {
    "rk4": RK4(),
    "heun": diffrax.Heun(),
    "midpoint": diffrax.Midpoint(),
    "tsit5": diffrax.Tsit5(),
    "dopri5": diffrax.Dopri5(),
}
