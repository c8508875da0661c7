"""Damped Gauss–Newton for all parameters of a field, network and physics, to a precision that Adam does not reach.

Levenberg–Marquardt (Levenberg 1944; Marquardt 1963). A step solves min ‖J δ + r‖² + μ ‖D δ‖², with D the lengths of the
columns of J. J is computed in the field's precision one window at a time, with the trajectory (`sensitivities`); JᵀJ is
summed, and the step solved, in double precision by NumPy, since squaring J would leave nothing of float32 for the
directions that matter least.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid, trainable
from hybrid_jax.integrate import RK4, Solver, checked, integrate
from hybrid_jax.networks.grids import GridNetwork
from hybrid_jax.status import Status, ended
from hybrid_jax.training.driver import ready
from hybrid_jax.training.sensitivities import with_sensitivities
from hybrid_jax.trajectories import Trajectories, check

MOST = 1000  # parameters: the cost of a step grows with their square
FIRST = 1e-2  # μ at the start
TRIALS = 10.0 ** np.arange(-2, 3)  # times the last μ: the best is taken
LEAST, LARGEST = 1e-12, 1e6  # of μ
SLOW = 1e-3  # stop after two steps that lower the loss by less than this share

Rows = Callable[[Hybrid, Float[Array, "t d"], Trajectories, Solver], Float[Array, " r"]]


class GaussNewtonFit(eqx.Module):
    """The result of `fit_gauss_newton`.

    Attributes:
        field: the best one that was found.
        loss: L_MSE on the windows plus λ times the penalty.
        steps: evaluations of J.
        status: how it ended; OK if it stopped before `max_steps`, at a finite loss.
    """

    field: AbstractVectorField
    loss: float
    steps: int
    status: Status


def residual_norm(field: Hybrid, predicted, window: Trajectories, solver: Solver) -> Float[Array, " r"]:
    """f_d along the predicted trajectory: its mean square is that of loss.py (Yin et al. 2021)."""
    x, u = jnp.concatenate([window.x0[None], predicted[:-1]]), window.u
    parts = jax.vmap(field.residual)(x, jnp.asarray(u))
    return parts.ravel() / len(u) ** 0.5


def trajectory_correlation(field: Hybrid, predicted, window: Trajectories, solver: Solver) -> Float[Array, " r"]:
    """(ŷ_p / ‖ŷ_p‖ − ŷ / ‖ŷ‖) / √2: its square is that of loss.py (Osaka et al. 2025, Eq. 7)."""
    physics = integrate(field.physics, jnp.asarray(window.x0), jnp.asarray(window.u), window.dt, solver)
    a, b = (y.ravel() / jnp.sqrt(jnp.sum(jnp.square(y)) + 1e-12) for y in (physics, predicted))
    return (a - b) / 2**0.5


def neighbour_weights(field: Hybrid, predicted, window: Trajectories, solver: Solver) -> Float[Array, " r"]:
    """The weights of a `GridNetwork` for all points but the one itself: small if f_d is a reaction.

    A small f_d need not be the true one, since a reaction and diffusion may cancel; what tells them apart is that a
    reaction does not depend on neighbours.
    """
    networks = [n for n in jax.tree.leaves(field, is_leaf=_is_grid) if _is_grid(n)]
    return jnp.concatenate([jnp.zeros(0), *(network.neighbour_weights().ravel() for network in networks)])


def _is_grid(node) -> bool:
    return isinstance(node, GridNetwork)


PENALTIES: dict[str, Rows] = {
    rule.__name__: rule for rule in (residual_norm, trajectory_correlation, neighbour_weights)
}


def fit_gauss_newton(
    field: AbstractVectorField,
    windows: Trajectories,
    *,
    penalty: str | None = None,
    weight: float = 0.0,
    max_steps: int = 50,
    solver: Solver | None = None,
    scale: Float[Array, " d"] | None = None,
) -> GaussNewtonFit:
    """Minimise L_MSE + λ L_reg over all parameters of a field by Gauss–Newton; a batch norm stays as it is.

    For networks of up to a thousand parameters and little data with little noise; there is no early stopping.

    Args:
        field: the field to begin with.
        windows: all are used in each step. A network without a scaling is scaled by them first, as in `fit`.
        penalty: L_reg, of a `Hybrid`: "residual_norm" or "trajectory_correlation" of `training.loss`, or
            "neighbour_weights", the squared weights of a `GridNetwork` for all points but the one itself.
        weight: λ.
        max_steps: evaluations of J at most.
        solver: by default `RK4`.
        scale: divides the error of each state, as in `fit_least_squares`.

    Raises:
        ValueError: malformed windows or others than the field's; no parameters, or too many; an unknown penalty, or
            one of a field that is no `Hybrid`; a weight that is negative.
    """
    check(windows, "windows")
    checked(field, windows.x0, windows.u, windows.dt, solver, windows=True)
    checks.not_negative("weight", weight)
    checks.count("max_steps", max_steps)
    if penalty is not None and (
        not isinstance(penalty, str) or penalty not in PENALTIES or not isinstance(field, Hybrid)
    ):
        known = ", ".join(PENALTIES)
        raise ValueError(f"penalty must be one of {known}, of a Hybrid, got {penalty!r} of {type(field).__name__}")
    size = sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(field, trainable(field))))
    if not 0 < size <= MOST:
        raise ValueError(f"field: 1 to {MOST} parameters expected for Gauss-Newton, got {size}; use fit")
    field = ready(field, windows)
    learned, rest = eqx.partition(field, trainable(field))
    rows = None if penalty is None else PENALTIES[penalty]
    if scale is not None:
        scale = checks.floating("scale", scale)
        if scale.shape != windows.x0.shape[1:] or not (scale > 0).all():
            raise ValueError(f"scale must be {windows.x0.shape[1:]} positive numbers, got shape {scale.shape}")
    problem = _Problem(learned, rest, jnp.asarray(weight, float), scale, rows, RK4() if solver is None else solver)
    return _descend(problem, jax.tree.map(jnp.asarray, windows), max_steps)


class _Problem(eqx.Module):
    """r(θ) of one window, such that the loss is the mean over windows of ‖r‖²."""

    learned: PyTree
    rest: PyTree
    weight: Float[Array, ""]
    scale: Float[Array, " d"] | None
    penalty: Rows | None = eqx.field(static=True)
    solver: Solver = eqx.field(static=True)

    def field(self, theta: Float[Array, " p"]) -> AbstractVectorField:
        return eqx.combine(ravel_pytree(self.learned)[1](theta), self.rest)

    def rows(self, candidate, predicted: Float[Array, "t d"], window: Trajectories) -> Float[Array, " r"]:
        errors = predicted - window.x if self.scale is None else (predicted - window.x) / self.scale
        found = errors.ravel() / len(window.u) ** 0.5
        if self.penalty is not None:
            held = self.penalty(candidate, predicted, window, self.solver)
            found = jnp.concatenate([found, jnp.sqrt(self.weight) * held])
        return found

    @eqx.filter_jit
    def losses(self, thetas: Float[Array, "k p"], windows: Trajectories) -> Float[Array, " k"]:
        def one(theta):
            candidate = self.field(theta)

            def square(window):
                x0, u = jnp.asarray(window.x0), jnp.asarray(window.u)
                predicted = integrate(candidate, x0, u, window.dt, self.solver)
                return jnp.sum(jnp.square(self.rows(candidate, predicted, window)))

            return jnp.mean(jax.lax.map(square, windows))

        return jax.lax.map(one, thetas)

    @eqx.filter_jit
    def linearised(
        self, theta: Float[Array, " p"], window: Trajectories
    ) -> tuple[Float[Array, "p r"], Float[Array, " r"]]:
        """Jᵀ and r of a window."""
        x0, u = jnp.asarray(window.x0), jnp.asarray(window.u)
        predicted, columns = with_sensitivities(self.field(theta), x0, u, window.dt, self.solver)

        def rows(theta, predicted):
            return self.rows(self.field(theta), predicted, window).astype(theta.dtype)

        r, push = jax.linearize(rows, theta, predicted)
        each = jnp.eye(theta.size, dtype=theta.dtype), jnp.moveaxis(columns, -1, 0)
        return jax.lax.map(lambda direction: push(*direction), each), r


def _descend(problem: _Problem, windows: Trajectories, max_steps: int) -> GaussNewtonFit:
    theta = ravel_pytree(problem.learned)[0]
    loss, damping, steps, slow = float(problem.losses(theta[None], windows)[0]), FIRST, 0, 0
    while steps < max_steps and slow < 2 and 0 < loss < np.inf:
        gram, score = _normal_equations(problem, theta, windows)
        lengths = np.sqrt(np.maximum(np.diag(gram), 1e-12 * np.diag(gram).max()))
        values, vectors = scipy.linalg.eigh(gram / np.outer(lengths, lengths))
        along = vectors.T @ (score / lengths)
        dampings = np.clip(damping * TRIALS, LEAST, LARGEST)
        moves = [vectors @ (along / (np.maximum(values, 0) + each)) / lengths for each in dampings]
        tried = theta - jnp.asarray(np.array(moves), theta.dtype)
        found = np.nan_to_num(np.asarray(problem.losses(tried, windows), float), nan=np.inf)
        best, steps = int(np.argmin(found)), steps + 1
        better = found[best] < loss
        slow = 0 if better and found[best] < (1 - SLOW) * loss else slow + 1
        damping = dampings[best] if better else min(damping * TRIALS[-1] * 10, LARGEST)
        theta, loss = (tried[best], float(found[best])) if better else (theta, loss)
    status = Status(int(ended(np.array(slow >= 2 or loss == 0), np.isfinite(loss))))
    return GaussNewtonFit(problem.field(theta), loss, steps, status)


def _normal_equations(
    problem: _Problem, theta, windows: Trajectories
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
    gram, score = np.zeros((theta.size, theta.size)), np.zeros(theta.size)
    for index in range(len(windows)):
        columns, r = (np.asarray(part, float) for part in problem.linearised(theta, windows[index]))
        gram, score = gram + columns @ columns.T, score + columns @ r
    return gram, score
