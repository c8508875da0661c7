"""Nonlinear least squares for the physical parameters θ_p; a hybrid's residual stays as it is.

Levenberg–Marquardt (Levenberg 1944; Marquardt 1963) needs tens of evaluations where Adam needs thousands. θ_p is in the
physics' own parametrisation: for a `RigidBody` the log-ratios.
"""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, ravel_learned
from hybrid_jax.dynamics.disturbance import physics_of, sized, with_physics
from hybrid_jax.dynamics.rigid_body import moves_a_rigid_body
from hybrid_jax.integrate import compact, rollout
from hybrid_jax.programs import kept_jit
from hybrid_jax.trajectories import Trajectories, check, check_attitudes

DAMPING = 1e-3  # at the start, relative to the diagonal of JᵀJ; Madsen, Nielsen and Tingleff (2004), Eq. 3.14

Solver = diffrax.AbstractSolver | None  # of the rollouts; RK4 by default
Scale = Float[Array, " d"] | None  # the error of each state that counts as 1; without one, 1 in its own unit
Theta = Float[Array, " p"]


class LeastSquaresFit(eqx.Module):
    """The result of `fit_least_squares`."""

    field: AbstractVectorField  # with the fitted θ_p; the start if no finite L_MSE was reached
    mse: Float[Array, ""]  # L_MSE on the windows, of errors over `scale`
    steps: Int[Array, ""]  # evaluations of the residuals and their Jacobian
    converged: Bool[Array, ""]  # whether it stopped before `max_steps`, at a finite L_MSE


class _LevenbergMarquardt(optimistix.LevenbergMarquardt):
    """Also stops before a step below the tolerance: round-off may reject such steps until the damping overflows."""

    def terminate(self, fn, y, args, options, state, tags):
        step = jnp.abs(state.y_eval - y) / (self.atol + self.rtol * jnp.abs(y))
        # Before the first evaluation the next step is not yet known, and zero.
        small = (self.norm(step) < 1) & (state.num_steps > 0)
        return state.terminate | small, state.result


def fit_least_squares(
    field: AbstractVectorField, windows: Trajectories, solver: Solver = None, max_steps: int = 100, scale: Scale = None
) -> LeastSquaresFit:
    """Minimise L_MSE, with the error of each state over `scale`, in inference mode over the θ_p of the field's physics.

    Pure: it compiles, maps over stacked fields, and reports failure in `converged` instead of raising. In float32 the
    precision is about 1e-3 standard errors.

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
    size, name = ravel_parameters(field)[0].size, type(physics_of(field)).__name__
    p = size if fitted is None else fitted
    if n <= p:
        raise ValueError(f"windows: {n} are too few for the {p} parameters of {name}, at least {p + 1} are needed")


def rounding(windows: Trajectories, scale: Scale) -> Float[Array, ""]:
    """How far rounding moves all states: a parameter with less effect than that cannot be fitted."""
    x = windows.x if scale is None else windows.x / scale
    return jnp.finfo(x.dtype).eps * jnp.linalg.norm(x.ravel())


@kept_jit
def fit_free(
    field: AbstractVectorField,
    windows: Trajectories,
    solver: Solver,
    max_steps: int,
    scale: Scale,
    free: Bool[Array, " p"] | None = None,
) -> LeastSquaresFit:
    """`fit_least_squares` without its checks; parameters that are not free, or have no effect, stay as they are."""
    start, unravel = ravel_parameters(field)

    def residuals(theta: Theta) -> Float[Array, "n t d"]:
        return jax.vmap(lambda window: prediction_errors(unravel(theta), window, solver, scale))(windows)

    def mse(residuals: Float[Array, "n t d"]) -> Float[Array, ""]:
        return jnp.mean(jnp.sum(jnp.square(residuals), axis=-1))

    # Each parameter is measured by what it does to the residuals, and these by their size at the start, so that the
    # damping and the tolerances, which are absolute numbers, mean the same for any units, data and field (Moré 1978).
    effects, at_start = jax.jacfwd(lambda theta: 2 * (residuals(theta),), has_aux=True)(start)
    size = _nonzero(jnp.linalg.norm(at_start))
    effect = jnp.linalg.norm(effects.reshape(-1, start.size), axis=0)
    seen = effect > rounding(windows, scale)
    unit = jnp.where(seen if free is None else free & seen, size / _nonzero(effect), 0)

    def theta_at(z: Theta) -> Theta:
        return (start + unit * z).astype(start.dtype)

    def objective(z: Theta, _) -> tuple[Float[Array, "n t d"], Float[Array, ""]]:
        found = residuals(theta_at(z))
        return (found / (size * DAMPING**0.5)).astype(z.dtype), mse(found)

    tolerance = float(jnp.finfo(start.dtype).eps) ** 0.75
    found = optimistix.least_squares(
        objective,
        _LevenbergMarquardt(tolerance, tolerance),  # pyright: ignore[reportCallIssue]
        jnp.zeros(start.shape),  # of JAX's default precision, as the solver's own numbers are
        has_aux=True,
        options={"jac": "fwd"},
        max_steps=max_steps,
        throw=False,
    )
    finite = jnp.isfinite(found.aux)
    return LeastSquaresFit(
        field=unravel(jnp.where(finite, theta_at(found.value), start)),
        mse=jnp.where(finite, found.aux, mse(at_start)),
        steps=jnp.asarray(found.stats["num_steps"], jnp.int32),
        converged=(found.result == optimistix.RESULTS.successful) & finite,
    )


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
