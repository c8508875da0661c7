"""Nonlinear least squares for the physical parameters θ_p, in the physics' own parametrisation."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax import checks
from hybrid_jax.batches import in_chunks
from hybrid_jax.dynamics.base import AbstractVectorField, ravel_learned
from hybrid_jax.dynamics.by_product import fixed_residual
from hybrid_jax.dynamics.disturbance import physics_of, sized, with_physics
from hybrid_jax.dynamics.window_checks import check_windows
from hybrid_jax.estimation.discretisation import Scale, Solver, compare_steps
from hybrid_jax.estimation.levenberg_marquardt import State, begin, corrected, judged, minimise, move_of_rows
from hybrid_jax.implicit_solvers import solver_errors, unsolved
from hybrid_jax.integrate import compact, rollout
from hybrid_jax.runtime import entry, jit_by_size, keep_programs
from hybrid_jax.status import Status
from hybrid_jax.trajectories import Trajectories, errors_of

MANY, CHUNK = 10_000, 1000  # more than MANY windows are compressed to a triangle, CHUNK at a time
TOGETHER = 64  # windows that are linearised at a time
LEAST = 0.1  # of the states' rounding: a step with a smaller expected decrease is the last

Theta = Float[Array, " p"]


class LeastSquaresFit(eqx.Module):
    """The result of `fit_least_squares`.

    Attributes:
        field: the field with the fitted θ_p, or the start if no L_MSE was finite.
        mse: L_MSE on the windows, with errors divided by `scale`.
        steps: the number of evaluations of the residuals and their Jacobian.
        status: how the fit ended.
        discretisation: the largest change of a parameter by half the solver's step, in standard errors; 0 if it is
            surely below 0.5 or predictions change only by rounding; -1 under `jit`, where it is unknown.
    """

    field: AbstractVectorField
    mse: Float[Array, ""]
    steps: Int[Array, ""]
    status: Int[Array, ""]
    discretisation: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(-1.0))

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether the fit stopped before `max_steps`, at a finite L_MSE."""
        return self.status == Status.OK


@entry
def fit_least_squares(
    field: AbstractVectorField,
    windows: Trajectories,
    *,
    solver: Solver = None,
    max_steps: int = 100,
    scale: Scale = None,
) -> LeastSquaresFit:
    """Fit the parameters θ_p of a field's physics by least squares; the field is in inference mode.

    You can use it under `jit` and `vmap`, and it reports failure in `status` instead of raising. In float32 it reaches
    the minimum within a few hundredths of a standard error. You get a warning if `discretisation` is above 0.5: you
    should then use a smaller step, since intervals do not include this error.

    Args:
        field: the initial field; a residual beside its physics does not change.
        windows: windows of the system. NaN in x means "not measured" and counts as no error.
        solver: the integrator over each interval, by default one step of RK4.
        max_steps: the maximum number of evaluations of the residuals and their Jacobian.
        scale: the error of each state that counts as 1 (d,), in its own unit; by default 1 for each.

    Raises:
        ValueError: if physics has no parameters, windows are malformed or do not fit the field, or an implicit solver
            finds no step.
    """
    windows = check_windows(field, windows, missing=True)
    checks.count("max_steps", max_steps)
    keep_programs("fit_least_squares", windows.x.shape)
    with solver_errors(solver):
        found = fit_free(sized(field, windows.x0.shape[-1]), windows, solver, max_steps, scale)
        if checks.is_traced(found.mse):
            return found
        if isinstance(solver, diffrax.AbstractImplicitSolver) and found.status == Status.DIVERGED:
            raise unsolved(solver)
        moved = compare_steps(found.field, windows, solver, scale, named=True)
    return replace(found, discretisation=jnp.array(moved))


def _linearised(errors: Callable[[Theta, Trajectories], Array], theta: Theta, windows: Trajectories):
    return jax.jacfwd(lambda theta: 2 * (jax.vmap(partial(errors, theta))(windows),), has_aux=True)(theta)


def _triangle(errors: Callable[[Theta, Trajectories], Array], theta: Theta, windows: Trajectories):
    """Compress all windows to p + 1 errors by QR, some at a time, so that memory does not grow with their number."""
    n, p = len(windows), theta.size

    def add(i, triangle):
        first = jnp.minimum(i * CHUNK, n - CHUNK)  # the last chunk repeats windows
        part = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, CHUNK), windows)
        jacobian, r = _linearised(errors, theta, part)
        rows = jnp.concatenate([jacobian.reshape(CHUNK, -1, p), r.reshape(CHUNK, -1, 1)], axis=2)
        rows = jnp.where((first + jnp.arange(CHUNK) >= i * CHUNK)[:, None, None], rows, 0)
        return jnp.linalg.qr(jnp.concatenate([triangle, rows.reshape(-1, p + 1)]), mode="r")

    found = jax.lax.fori_loop(0, -(-n // CHUNK), add, jnp.zeros((p + 1, p + 1), jnp.result_type(theta, windows.x)))
    return found[None, None, :, :p], found[None, None, :, p]


def rounding(windows: Trajectories, scale: Scale) -> Float[Array, ""]:
    """Return the norm of rounding errors of all states: parameters with less effect cannot be fitted."""
    x = jnp.nan_to_num(windows.x) / (1 if scale is None else scale)
    return jnp.finfo(x.dtype).eps * jnp.linalg.norm(x.ravel())


@jit_by_size()
def fit_free(
    field: AbstractVectorField,
    windows: Trajectories,
    solver: Solver,
    max_steps: int,
    scale: Scale,
    free: Bool[Array, " p"] | None = None,
) -> LeastSquaresFit:
    """Run `fit_least_squares` without its checks; parameters that are not free, or have no effect, do not change."""
    return fit_and_linearise(field, windows, solver, max_steps, scale, free)[0]


def fit_and_linearise(
    field: AbstractVectorField,
    windows: Trajectories,
    solver: Solver,
    max_steps: int,
    scale: Scale,
    free=None,
    weigh: Callable[[Float[Array, "n t d"]], Float[Array, "n s d"]] | None = None,
    held: Theta | float = 0.0,
    distinct: Int[Array, ""] | None = None,
    known: tuple[Array, Array, Bool[Array, ""]] | None = None,
    moved: Theta | float = 0.0,
) -> tuple[LeastSquaresFit, Float[Array, "n s d p"], Float[Array, "n s d"]]:
    """Run `fit_free` and return also the Jacobian of the predictions and their negative errors at the end.

    Points are in the units of `_units`. More than `MANY` unweighted windows are compressed by `_triangle`.

    Args:
        weigh: an affine map of the errors, such as `starts.projected`.
        held: error per unit of a parameter's distance from the start minus `moved`, where a failed fit ends.
        distinct: how many windows are distinct, if the others repeat them in order.
        known: the Jacobian and the errors at the start, and whether they are valid; else they are computed.
    """
    start, unravel = ravel_parameters(field)
    compressed, own = weigh is None and len(windows) > MANY, weigh or (lambda errors: errors)

    def errors(theta: Theta, window: Trajectories):
        return prediction_errors(fixed_residual(unravel(theta)), window, solver, scale)

    def linearised(theta: Theta):
        if compressed:
            return _triangle(errors, theta, windows)
        jacobian, found = in_chunks(partial(_linearised, errors, theta), windows, TOGETHER, distinct)
        found, push = jax.linearize(own, found)
        return jax.vmap(push, -1, -1)(jacobian), found

    def theta_at(z: Theta, unit: Theta) -> Theta:
        return (start + unit * z).astype(start.dtype)

    def scaled(array, size):
        return (array / size).astype(float).reshape(-1, *array.shape[3:])

    def anchor(z: Theta, units):
        slope = jnp.broadcast_to(held, start.shape) / units[1]
        return (slope * units[0]).astype(float), (slope * (moved + units[0] * z)).astype(float)

    def cost_of(z: Theta, found, units):
        return jnp.sum(jnp.square(scaled(found, units[1]))) + jnp.sum(jnp.square(anchor(z, units)[1]))

    def bent(tried, state: State) -> tuple[Theta, Float[Array, ""]]:
        (z, upper), (before, found, jacobian, units) = tried, state.best

        def cost_and_errors(z):
            r = own(in_chunks(jax.vmap(partial(errors, theta_at(z, units[0]))), windows, TOGETHER, distinct))
            return cost_of(z, r, units), r

        def correction(z, r):
            missed = r - found - jacobian @ (units[0] * (z - before)).astype(r.dtype)
            slope = scaled(jacobian * units[0], units[1]).T @ scaled(missed, units[1])
            return -solve_triangular(upper, solve_triangular(upper, slope, trans=1))

        return corrected(cost_and_errors, correction, z)

    def evaluate(tried, state: State):
        (z, _), (before, found, jacobian, units) = tried, state.best
        if compressed:
            jacobian, found = linearised(theta_at(z, units[0]))
        else:
            z, cost = bent(tried, state)
            moved = jnp.where(state.steps == 0, known is None or ~known[2], jnp.any(z != before))
            at, last = theta_at(z, units[0]), (jacobian, found)
            jacobian, found = jax.lax.cond(judged(state, cost)[0] & moved, linearised, lambda _: last, at)
        first = state.steps == 0
        units = jax.tree.map(partial(jnp.where, first), _units(jacobian, found, windows, scale, free, held), units)
        cost = cost_of(z, found, units) if compressed else jnp.where(first, cost_of(z, found, units), cost)
        return cost, (z, found, jacobian, units)

    def aim(best, damping):
        z, found, jacobian, (unit, size) = best
        slope, away = anchor(z, (unit, size))
        rows, r = scaled(jacobian * unit, size), jnp.concatenate([scaled(found, size), away])
        move, expected, upper = move_of_rows(jnp.concatenate([rows, jnp.diag(slope)]), r, damping)
        return (z + move, upper), expected, jnp.square(LEAST * rounding(windows, scale) / size)

    shape = jax.eval_shape(lambda: linearised(start)[1] if compressed else own(jnp.asarray(windows.x)))
    zero = jnp.zeros(start.shape)  # in JAX's default precision, like the loop's numbers except the errors
    nothing = jnp.zeros((*shape.shape, start.size), shape.dtype), jnp.zeros(shape.shape, shape.dtype)
    jacobian, found = nothing if known is None else known[:2]
    units = jnp.zeros(start.shape, shape.dtype), jnp.ones((), shape.dtype)
    end = minimise(evaluate, aim, begin((zero, jnp.eye(start.size)), (zero, found, jacobian, units)), max_steps)
    z, found, jacobian, (unit, _) = end.best
    mse = jnp.sum(jnp.square(found)) / (len(windows) * (windows.horizon if weigh is None else found.shape[1]))
    theta = jnp.where(jnp.isfinite(mse), theta_at(z, unit), (start - moved).astype(start.dtype))
    blind = (free is None or jnp.any(free)) & jnp.all(unit == 0) & (end.status == Status.OK)  # no effect at all
    status = jnp.where(blind, Status.STALLED, end.status)
    return LeastSquaresFit(unravel(theta), mse, end.steps, status), jacobian, found


def _units(jacobian, errors, windows: Trajectories, scale: Scale, free, held) -> tuple[Theta, Float[Array, ""]]:
    """Return units of the parameters and errors in which dampings and tolerances are dimensionless (Moré 1978)."""
    size, effect = _nonzero(jnp.linalg.norm(errors)), jnp.linalg.norm(jacobian.reshape(-1, jacobian.shape[-1]), axis=0)
    seen, effect = effect > rounding(windows, scale), jnp.sqrt(jnp.square(effect) + jnp.square(held))
    return jnp.where(seen if free is None else free & seen, size / _nonzero(effect), 0), size


def ravel_parameters(field: AbstractVectorField) -> tuple[Theta, Callable[[Theta], AbstractVectorField]]:
    """Return θ_p as a vector in the order of the physics' leaves, and the field as its function; ValueError if none."""
    physics = physics_of(field)
    theta, at = ravel_learned(physics)
    if theta.size == 0:
        raise ValueError(f"field: its physics, {type(physics).__name__}, has no parameter to fit")
    return theta, lambda theta: with_physics(field, at(theta))


@jit_by_size()
def prediction_errors(
    field: AbstractVectorField, window: Trajectories, solver: Solver = None, scale: Scale = None
) -> Float[Array, "t d"]:
    """Return (x_t − x̂_t) / scale of one window, zero if not measured, with x̂ in inference mode."""
    errors = -errors_of(rollout(field, window.x0, window.u, window.dt, compact(solver)), jnp.asarray(window.x))
    return errors if scale is None else (errors / scale).astype(errors.dtype)


def _nonzero(size: Float[Array, "*p"]) -> Float[Array, "*p"]:
    return jnp.where(size > 0, size, 1)  # a parameter without effect then does not change
