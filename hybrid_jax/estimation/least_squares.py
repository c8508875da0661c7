"""Nonlinear least squares for the physical parameters θ_p; a hybrid's residual stays as it is.

Levenberg–Marquardt (Levenberg 1944; Marquardt 1963) needs tens of evaluations where Adam needs thousands. θ_p is in the
physics' own parametrisation: for a `RigidBody` the log-ratios.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, ravel_learned
from hybrid_jax.dynamics.disturbance import physics_of, sized, with_physics
from hybrid_jax.dynamics.rigid_body import moves_a_rigid_body
from hybrid_jax.integrate import compact, rollout
from hybrid_jax.status import Status, ended
from hybrid_jax.trajectories import Trajectories, check, check_attitudes

DAMPING = 1e-3  # at the start, relative to the diagonal of JᵀJ; Madsen, Nielsen and Tingleff (2004), Eq. 3.14
LEAST = 0.1  # of what rounding does to the states: a step of which less is expected is the last
HIDDEN = 10  # times the rounding of one number: what rounding does to the sum of squares

Solver = diffrax.AbstractSolver | None  # of the rollouts; RK4 by default
Scale = Float[Array, " d"] | None  # the error of each state that counts as 1; without one, 1 in its own unit
Theta = Float[Array, " p"]


class LeastSquaresFit(eqx.Module):
    """The result of `fit_least_squares`.

    Attributes:
        field: with the fitted θ_p; the start if no finite L_MSE was reached.
        mse: L_MSE on the windows, of errors over `scale`.
        steps: evaluations of the residuals and their Jacobian.
        status: how it ended, a `Status`.
    """

    field: AbstractVectorField
    mse: Float[Array, ""]
    steps: Int[Array, ""]
    status: Int[Array, ""]

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether it stopped before `max_steps`, at a finite L_MSE."""
        return self.status == Status.OK


def fit_least_squares(
    field: AbstractVectorField, windows: Trajectories, solver: Solver = None, max_steps: int = 100, scale: Scale = None
) -> LeastSquaresFit:
    """Minimise L_MSE, with the error of each state over `scale`, in inference mode over the θ_p of the field's physics.

    Pure: it compiles, maps over stacked fields, and reports failure in `converged` instead of raising. In float32 the
    minimum is met within a few hundredths of a standard error.

    Args:
        field: its θ_p is the start; a residual beside the physics stays as it is.
        windows: of the system whose θ_p is sought.
        solver: takes the field from sample to sample, by default one step of RK4 each.
        max_steps: the most evaluations of the residuals and their Jacobian.
        scale: the error of each state that counts as 1 (d,), in its own unit; by default 1 for each.

    Raises:
        ValueError: the physics has no parameter, or windows that are malformed or not of this field.
    """
    check_windows(field, windows)
    checks.count("max_steps", max_steps)
    return fit_free(sized(field, windows.x0.shape[-1]), windows, solver, max_steps, scale)


def check_windows(field: AbstractVectorField, windows: Trajectories, name: str = "windows") -> None:
    """Refuse malformed windows, and those of a rigid body without unit quaternions."""
    check(windows, name)
    if moves_a_rigid_body(field):
        check_attitudes(windows, name)


def check_determined(field: AbstractVectorField, n: int, fitted: int | None = None) -> None:
    """Refuse n windows if as many parameters or more are fitted, by default all of the physics, or if it has none."""
    size, name = jax.eval_shape(lambda: ravel_parameters(field)[0]).size, type(physics_of(field)).__name__
    p = size if fitted is None else fitted
    if n <= p:
        raise ValueError(f"windows: {n} are too few for the {p} parameters of {name}, at least {p + 1} are needed")


def rounding(windows: Trajectories, scale: Scale) -> Float[Array, ""]:
    """How far rounding moves all states: a parameter with less effect than that cannot be fitted."""
    x = windows.x if scale is None else windows.x / scale
    return jnp.finfo(x.dtype).eps * jnp.linalg.norm(x.ravel())


@eqx.filter_jit
def fit_free(
    field: AbstractVectorField,
    windows: Trajectories,
    solver: Solver,
    max_steps: int,
    scale: Scale,
    free: Bool[Array, " p"] | None = None,
) -> LeastSquaresFit:
    """`fit_least_squares` without its checks; parameters that are not free, or have no effect, stay as they are."""
    return fit_and_linearise(field, windows, solver, max_steps, scale, free)[0]


class _State(NamedTuple):
    """The best point so far, and one to try. Points are in units, see `_units`.

    Attributes:
        z: the best point.
        tried: the point to try.
        errors: of the predictions at z.
        jacobian: of the errors at z, by θ_p.
        units: of parameters and of errors.
        expected: decrease of the squared errors in units.
        last: whether so little is expected that rounding hides it.
        damping: relative to the diagonal of JᵀJ.
        steps: evaluations so far.
        converged: whether the last step was tried.
    """

    z: Theta
    tried: Theta
    errors: Float[Array, "n t d"]
    jacobian: Float[Array, "n t d p"]
    units: tuple[Theta, Float[Array, ""]]
    expected: Float[Array, ""]
    last: Bool[Array, ""]
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def fit_and_linearise(
    field: AbstractVectorField, windows: Trajectories, solver: Solver, max_steps: int, scale: Scale, free=None
) -> tuple[LeastSquaresFit, Float[Array, "n t d p"], Float[Array, "n t d"]]:
    """`fit_free`, and there the Jacobian of the predictions, and their errors with the opposite sign.

    The loop is ours, not Optimistix's, so that one rollout serves the start, the steps and the end: a first call takes
    less than half as long, and an adaptation does not fit beyond what rounding lets it see.
    """
    start, unravel = ravel_parameters(field)

    def errors(theta: Theta):
        return 2 * (jax.vmap(lambda window: prediction_errors(unravel(theta), window, solver, scale))(windows),)

    def theta_at(z: Theta, unit: Theta) -> Theta:
        return (start + unit * z).astype(start.dtype)

    def step(state: _State) -> _State:
        jacobian, found = jax.jacfwd(errors, has_aux=True)(theta_at(state.tried, state.units[0]))
        first = state.steps == 0
        units = jax.tree.map(partial(jnp.where, first), _units(jacobian, found, windows, scale, free), state.units)
        least = LEAST * rounding(windows, scale) / units[1]
        return _improved(state, jacobian, found, units, first, least)

    shape = jax.eval_shape(lambda: errors(start)[0])
    zero = jnp.zeros(start.shape)  # of JAX's default precision, as all numbers of the loop but the errors are
    nothing = jnp.zeros(shape.shape, shape.dtype), jnp.zeros((*shape.shape, start.size), shape.dtype)
    units = jnp.zeros(start.shape, shape.dtype), jnp.ones((), shape.dtype)
    no = jnp.array(False)
    begin = _State(zero, zero, *nothing, units, jnp.zeros(()), no, jnp.full((), DAMPING), jnp.zeros((), jnp.int32), no)
    end = jax.lax.while_loop(
        lambda state: (state.steps < max_steps) & ~state.converged & jnp.isfinite(state.tried).all(), step, begin
    )
    mse = jnp.mean(jnp.sum(jnp.square(end.errors), axis=-1))
    finite = jnp.isfinite(mse)
    theta = jnp.where(finite, theta_at(end.z, end.units[0]), start)
    return LeastSquaresFit(unravel(theta), mse, end.steps, ended(end.converged, finite)), end.jacobian, end.errors


def _units(jacobian, errors, windows: Trajectories, scale: Scale, free) -> tuple[Theta, Float[Array, ""]]:
    """Of parameters and of errors.

    Each parameter is measured by what it does to the errors, and these by their size at the start, so that the damping
    and the tolerances, which are absolute numbers, mean the same for any units, data and field (Moré 1978).
    """
    size = _nonzero(jnp.linalg.norm(errors))
    effect = jnp.linalg.norm(jacobian.reshape(-1, jacobian.shape[-1]), axis=0)
    seen = effect > rounding(windows, scale)
    return jnp.where(seen if free is None else free & seen, size / _nonzero(effect), 0), size


def _improved(state: _State, jacobian, errors, units, first, least) -> _State:
    """The state after a point was tried. The damping changes as in Gould, Orban, Sartenaer and Toint (2005)."""
    unit, size = units

    def scaled(array):
        return (array / size).astype(state.z.dtype).reshape(-1, *array.shape[3:])

    change = jnp.sum(jnp.square(scaled(errors))) - jnp.sum(jnp.square(scaled(state.errors)))
    accepted = first | (change <= -0.01 * state.expected) | (state.last & jnp.isfinite(change))
    good = ~first & (change < -0.99 * state.expected)
    damping = state.damping * jnp.where(accepted, jnp.where(good, 1 / 3.5, 1), 4)
    tried, known = (state.tried, errors, jacobian), (state.z, state.errors, state.jacobian)
    z, errors, jacobian = jax.tree.map(partial(jnp.where, accepted), tried, known)
    p, r = len(z), scaled(errors)
    rows = jnp.concatenate([scaled(jacobian * unit), r[:, None]], axis=1)
    upper = jnp.linalg.qr(jnp.concatenate([rows, jnp.sqrt(damping) * jnp.eye(p, p + 1)]), mode="r")
    move = -jax.scipy.linalg.solve_triangular(upper[:p, :p], upper[:p, p])
    expected = jnp.sum(jnp.square(upper[:p, p])) + damping * move @ move
    last = expected <= jnp.maximum(least**2, HIDDEN * jnp.finfo(errors.dtype).eps * r @ r)
    return _State(z, z + move, errors, jacobian, units, expected, last, damping, state.steps + 1, state.last)


def ravel_parameters(field: AbstractVectorField) -> tuple[Theta, Callable[[Theta], AbstractVectorField]]:
    """θ_p as a vector, in the order of the physics' leaves, and the field as a function of it; ValueError if none."""
    physics = physics_of(field)
    theta, at = ravel_learned(physics)
    if theta.size == 0:
        raise ValueError(f"field: its physics, {type(physics).__name__}, has no parameter to fit")
    return theta, lambda theta: with_physics(field, at(theta))


@eqx.filter_jit
def prediction_errors(
    field: AbstractVectorField, window: Trajectories, solver: Solver = None, scale: Scale = None
) -> Float[Array, "t d"]:
    """(x_t − x̂_t) / scale of one window, x̂ in inference mode."""
    errors = jnp.asarray(window.x) - rollout(field, window.x0, window.u, window.dt, compact(solver))
    return errors if scale is None else (errors / scale).astype(errors.dtype)


def _nonzero(size: Float[Array, "*p"]) -> Float[Array, "*p"]:
    return jnp.where(size > 0, size, 1)  # a parameter without effect then stays where it is
