"""Damped Gauss–Newton for all parameters of a field, network and physics, to a precision that Adam does not reach.

The search is `elimination.descend`, as for records: a step solves min ‖J δ + r‖² + μ ‖D δ‖², with D the column norms of
J, in double precision. Squaring J in float32 would lose the least sensitive directions.
"""

from collections.abc import Callable
from dataclasses import replace

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, as_field, parts_of, ravel_learned
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.outputs import StateSpaceModel, dynamics_of
from hybrid_jax.dynamics.window_checks import check_windows
from hybrid_jax.estimation.discretisation import compare_steps
from hybrid_jax.estimation.elimination import descend
from hybrid_jax.estimation.normal_equations import NormalEquations
from hybrid_jax.estimation.record_windows import RecordWindows, checked_windows, states_of
from hybrid_jax.integrate import RK4, Solver, checked, integrate
from hybrid_jax.networks.grids import GridNetwork
from hybrid_jax.runtime import entry
from hybrid_jax.status import Status
from hybrid_jax.training.driver import ready
from hybrid_jax.training.loss import correlation_rows
from hybrid_jax.training.objective import Learner
from hybrid_jax.trajectories import Trajectories, errors_of, overflows

MOST = 1000  # parameters: the cost of a step grows with their square
FIRST = 1e-2  # μ at the start
SLOW = 1e-3  # share of the loss: a step that lowers it by less is slow

Rows = Callable[[Hybrid, Float[Array, "t d"], Trajectories, Solver], Float[Array, " r"]]


class GaussNewtonFit(eqx.Module):
    """The result of `fit_gauss_newton`.

    Attributes:
        field: the best field found, or the best `StateSpaceModel`.
        loss: its loss, L_MSE on the windows plus λ times the penalty.
        steps: the number of points that were tried.
        status: how the fit ended: OK if it stopped before `max_steps`, at a finite loss.
        discretisation: the effect of half the solver's step, as in `FitResult`, with a warning above 0.5; -1 for
            windows of records.
    """

    field: Learner
    loss: float
    steps: int
    status: Status
    discretisation: float = -1.0


def residual_norm(field: Hybrid, predicted, window: Trajectories, solver: Solver) -> Float[Array, " r"]:
    """Return f_d along the predicted trajectory, whose mean square is `loss.residual_norm` (Yin et al. 2021)."""
    x, u = jnp.concatenate([window.x0[None], predicted[:-1]]), window.u
    parts = jax.vmap(lambda x, u: field.residual(field.read(x), u))(x, jnp.asarray(u))
    return parts.ravel() / len(u) ** 0.5


def trajectory_correlation(field: Hybrid, predicted, window: Trajectories, solver: Solver) -> Float[Array, " r"]:
    """Return a vector whose square is `loss.trajectory_correlation` (Osaka et al. 2025, Eq. 7)."""
    physics = integrate(field.physics, jnp.asarray(window.x0), jnp.asarray(window.u), window.dt, solver)
    return correlation_rows(*(y.ravel()[:, None] for y in (physics, predicted))).ravel()


def neighbour_weights(field: Hybrid, predicted, window: Trajectories, solver: Solver) -> Float[Array, " r"]:
    """Return the weights of a `GridNetwork` for all points except the centre, which are zero for a reaction."""
    networks = (part for part in parts_of(field) if isinstance(part, GridNetwork))
    return jnp.concatenate([jnp.zeros(0), *(network.neighbour_weights().ravel() for network in networks)])


PENALTIES: dict[str, Rows] = {one.__name__: one for one in (residual_norm, trajectory_correlation, neighbour_weights)}


@entry
def fit_gauss_newton(
    field: Learner,
    windows: Trajectories | RecordWindows,
    *,
    penalty: str | None = None,
    weight: float = 0.0,
    max_steps: int = 50,
    solver: Solver | None = None,
    scale: Float[Array, " d"] | None = None,
) -> GaussNewtonFit:
    """Fit all parameters of a field by Gauss–Newton: minimise L_MSE + λ L_reg. Running statistics do not change.

    You should use it for up to a thousand parameters, and for few data with little noise: there is no early stopping.

    Args:
        field: the initial field, or a `StateSpaceModel` for windows of records.
        windows: the data, all of which are used in each step. They scale a network that has no scaling, as in `fit`. If
            only some states are measured, use windows of `estimate_windows`; L_MSE is then relative to the noise.
        penalty: L_reg of a `Hybrid`: "residual_norm" or "trajectory_correlation" of `training.loss`, or
            "neighbour_weights", the squared weights of a `GridNetwork` for all points except the centre.
        weight: λ, the weight of the penalty.
        max_steps: the maximum number of points to try.
        solver: the integrator, by default `RK4`.
        scale: a divisor for the error of each state, as in `fit_least_squares`; not for windows of records.

    Raises:
        ValueError: if windows are invalid or do not match the field, there are no parameters or too many, the penalty
            is unknown or the field is not a `Hybrid`, or the weight is negative.
    """
    checks.not_traced("fit_gauss_newton", field, windows)
    if isinstance(windows, RecordWindows):
        checks.instance("field", field, StateSpaceModel)
        checked_windows(windows, "windows")
    else:
        windows = check_windows(field, windows, missing=True)
    states, dynamics = states_of(windows), dynamics_of(field)
    checked(dynamics, states.x0, states.u, states.dt, solver, windows=True)
    checks.not_negative("weight", weight)
    checks.count("max_steps", max_steps)
    valid = isinstance(penalty, str) and penalty in PENALTIES and isinstance(dynamics, Hybrid)
    if penalty is not None and not valid:
        known = ", ".join(PENALTIES)
        raise ValueError(f"penalty must be one of {known}, for a Hybrid, got {penalty!r} for {type(dynamics).__name__}")
    size = ravel_learned(field)[0].size
    if not 0 < size <= MOST:
        raise ValueError(f"field: 1 to {MOST} parameters expected for Gauss-Newton, got {size}; use fit")
    field = ready(field, windows)
    rows = None if penalty is None else PENALTIES[penalty]
    scale = None if scale is None else _checked_scale(scale, windows)
    if scale is None and overflows(states):
        return GaussNewtonFit(field, np.inf, 0, Status.DIVERGED)
    count = windows.samples / len(windows) if isinstance(windows, RecordWindows) else states.horizon
    problem = _Problem(field, jnp.asarray(weight, float), scale, count**-0.5, rows, RK4() if solver is None else solver)
    found = _descend(problem, jax.tree.map(jnp.asarray, windows), max_steps)
    if found.status == Status.DIVERGED or isinstance(windows, RecordWindows):
        return found
    return replace(found, discretisation=compare_steps(found.field, windows, problem.solver, scale))


def _checked_scale(scale: Float[Array, " d"], windows: Trajectories | RecordWindows) -> Float[Array, " d"]:
    scale, records = checks.floating("scale", scale), isinstance(windows, RecordWindows)
    size = states_of(windows).x0.shape[1:]
    if records or scale.shape != size or not (scale > 0).all():
        expected = "None for windows of records" if records else f"{size} positive numbers"
        raise ValueError(f"scale must be {expected}, got shape {scale.shape}")
    return scale


class _Problem(eqx.Module):
    """The residuals r(θ) of one window; the loss is the mean of ‖r‖² over windows."""

    source: Learner
    weight: Float[Array, ""]
    scale: Float[Array, " d"] | None
    share: Float[Array, ""] | float  # each error's, so that L_MSE is the mean over all samples
    penalty: Rows | None = eqx.field(static=True)
    solver: Solver = eqx.field(static=True)

    def at(self, theta: Float[Array, " p"]) -> Learner:
        return ravel_learned(self.source)[1](theta)

    def rows(self, candidate: Learner, predicted: Float[Array, "t d"], window) -> Float[Array, " r"]:
        if isinstance(window, RecordWindows):
            errors = window.errors(candidate, predicted)
        else:
            errors = errors_of(predicted, window.x) / (1 if self.scale is None else self.scale)
        found = errors.ravel() * self.share
        if self.penalty is not None:
            held = self.penalty(dynamics_of(candidate), predicted, states_of(window), self.solver)
            found = jnp.concatenate([found, jnp.sqrt(self.weight) * held])
        return found

    @eqx.filter_jit
    def loss(self, theta: Float[Array, " p"], windows: Trajectories | RecordWindows) -> Float[Array, ""]:
        candidate = self.at(theta)

        def square(window):
            own = states_of(window)
            x0, u = jnp.asarray(own.x0), jnp.asarray(own.u)
            predicted = integrate(dynamics_of(candidate), x0, u, own.dt, self.solver)
            return jnp.sum(jnp.square(self.rows(candidate, predicted, window)))

        return jnp.mean(jax.lax.map(square, windows))

    @eqx.filter_jit
    def linearised(
        self, theta: Float[Array, " p"], window: Trajectories | RecordWindows
    ) -> tuple[Float[Array, "p r"], Float[Array, " r"]]:
        own = states_of(window)
        x0, u = jnp.asarray(own.x0), jnp.asarray(own.u)
        predicted, columns = with_sensitivities(dynamics_of(self.at(theta)), x0, u, own.dt, self.solver)
        # In a `StateSpaceModel`, what the outputs learn comes after the field, and moves no state.
        columns = jnp.pad(columns, ((0, 0), (0, 0), (0, theta.size - columns.shape[-1])))

        def rows(theta, predicted):
            return self.rows(self.at(theta), predicted, window).astype(theta.dtype)

        r, push = jax.linearize(rows, theta, predicted)
        each = jnp.eye(theta.size, dtype=theta.dtype), jnp.moveaxis(columns, -1, 0)
        return jax.lax.map(lambda direction: push(*direction), each), r


def _descend(problem: _Problem, windows: Trajectories | RecordWindows, max_steps: int) -> GaussNewtonFit:
    start, wide = ravel_learned(problem.source)[0], jax.config.read("jax_enable_x64")

    def rounded(theta):  # to the precision of the field's programs
        return jnp.asarray(np.asarray(theta), start.dtype)

    def cost(theta, own):
        with jax.enable_x64(wide):
            return np.asarray(problem.loss(rounded(theta), windows), float)

    def equations(theta, own):
        with jax.enable_x64(wide):
            found = _normal_equations(problem, rounded(theta), windows)
        return NormalEquations(*map(jnp.asarray, found))

    with jax.enable_x64(True):
        options = {"max_steps": max_steps, "tolerance": SLOW, "damping": FIRST, "cost": cost}
        end = descend(equations, jnp.asarray(start, float), jnp.zeros((1, 0)), **options)
    return GaussNewtonFit(problem.at(rounded(end.theta)), float(cost(end.theta, end.own)), end.steps, end.status)


def _normal_equations(
    problem: _Problem, theta, windows: Trajectories | RecordWindows
) -> tuple[Float[np.ndarray, "1 p p"], Float[np.ndarray, "1 p"], Float[np.ndarray, " 1"]]:
    gram, score, square = np.zeros((theta.size, theta.size)), np.zeros(theta.size), 0.0
    for index in range(len(windows)):
        columns, r = (np.asarray(part, float) for part in problem.linearised(theta, windows[index]))
        gram, score, square = gram + columns @ columns.T, score + columns @ r, square + r @ r
    return gram[None] / len(windows), score[None] / len(windows), np.array([square / len(windows)])


def with_sensitivities(
    field: AbstractVectorField, x0: Float[Array, " d"], u: Float[Array, "t m"], dt: float, solver: Solver
) -> tuple[Float[Array, "t d"], Float[Array, "t d p"]]:
    """Return the states of `integrate` and their derivatives with respect to each learned number, in leaf order.

    The derivative of an explicit Runge–Kutta method is the same method on ẋ = f(x, θ), Ṡ = ∂f/∂x S + ∂f/∂θ: internal
    numerical differentiation (Bock, "Numerical treatment of inverse problems in chemical reaction kinetics", 1981).
    Values shared by all parameters, for example slopes of a network at each point of a grid, are computed once.
    """
    theta, at = ravel_learned(field)
    if not isinstance(solver, RK4 | diffrax.AbstractERK):
        states, push = jax.linearize(lambda theta: integrate(at(theta), x0, u, dt, solver), theta)
        return states, jnp.moveaxis(jax.lax.map(push, jnp.eye(theta.size, dtype=theta.dtype)), 0, -1)

    def slopes(both: Float[Array, "d 1+p"], held):
        x, columns = both[:, 0], both[:, 1:]
        value, moved = as_field(field).linearize(x, held, columns, jnp.zeros((len(held), theta.size), held.dtype))
        return jnp.concatenate([value[:, None], moved + as_field(field).parameter_columns(x, held)], axis=1)

    start = jnp.concatenate([x0[:, None], jnp.zeros((len(x0), theta.size), x0.dtype)], axis=1)
    both = integrate(slopes, start, u, dt, solver)
    return both[..., 0], both[..., 1:]
