"""θ_p of a hybrid by least squares and, if the windows need one, a constant disturbance beside it.

Six accelerations more fit any windows better. Where there is no steady push they fit what the network gets wrong, which
is of no use to the next flight. So each window is predicted by a fit to all others, with a disturbance and without one
(leave-one-out cross-validation; Stone 1974), and the simpler model is kept unless it is worse by more than the standard
error of that difference (Breiman, Friedman, Olshen and Stone, Classification and Regression Trees, 1984, Sec. 3.4.3).
No fit is repeated: what one window leaves behind is solved from the normal equations at the minimum, which is exact
where the residuals are linear (PRESS; Allen 1974).

Windows are what is left out, and so what must be independent; the errors within one need not be.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax.adaptation.least_squares import LeastSquaresFit, fit_least_squares, physics_of
from hybrid_jax.adaptation.uncertainty import inverse, normal_equations
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid
from hybrid_jax.dynamics.disturbance import with_disturbance
from hybrid_jax.trajectories import Trajectories


class SelectedFit(eqx.Module):
    """What was fitted.

    Attributes:
        fit: the one that was kept; its field has a disturbance of zero where the windows need none.
        needed: whether they need one.
        gain: by how much it lowers L_MSE of windows that were left out, per window.
        error: the standard error of this.
    """

    fit: LeastSquaresFit
    needed: Bool[Array, ""]
    gain: Float[Array, ""]
    error: Float[Array, ""]


def fit_with_selected_disturbance(
    field: Hybrid, windows: Trajectories, solver: diffrax.AbstractSolver | None = None, max_steps: int = 100
) -> SelectedFit:
    """Minimise L_MSE over θ_p and, if that predicts windows that were left out better, a constant disturbance.

    Pure, as `fit_least_squares`. A single window, or windows that do not tell the parameters apart, need no
    disturbance.

    Args:
        windows: n independent ones.
        solver: integrates the rollouts; RK4 by default.
        max_steps: of each of the two fits.

    Raises:
        ValueError: no hybrid; as `fit_least_squares`.
    """
    richer = fit_least_squares(with_disturbance(field), windows, solver, max_steps)
    plain = fit_least_squares(field, windows, solver, max_steps)
    return _choice(field, plain, richer, windows, solver)


@eqx.filter_jit
def _choice(
    field: Hybrid, plain: LeastSquaresFit, richer: LeastSquaresFit, windows: Trajectories, solver
) -> SelectedFit:
    without, having = (left_out(fit.field, windows, solver) for fit in (plain, richer))
    gains = without - having
    gain, error = jnp.mean(gains), jnp.std(gains, ddof=1) / jnp.sqrt(len(windows))
    needed = gain > error  # never where one of them is not finite
    still = with_disturbance(Hybrid(physics_of(plain.field), field.residual))
    at_rest = eqx.tree_at(lambda fit: fit.field, plain, still)
    kept = jax.tree.map(lambda one, other: jnp.where(needed, one, other), richer, at_rest)
    return SelectedFit(kept, needed, gain, error)


def left_out(
    field: AbstractVectorField, windows: Trajectories, solver: diffrax.AbstractSolver | None = None
) -> Float[Array, " n"]:
    """L_MSE of each window as predicted by a fit of θ_p to all others, to first order in what that changes in θ_p.

    Not finite where the others do not tell the parameters apart.

    Args:
        field: one whose θ_p minimises L_MSE of all windows.
    """
    gram, score, square = normal_equations(field, windows, solver)
    others = jnp.sum(gram, axis=0) - gram, jnp.sum(score, axis=0) - score
    steps = -jnp.einsum("npq,nq->np", jax.vmap(inverse)(others[0]), others[1])
    bent = jnp.einsum("np,npq,nq->n", steps, gram, steps)
    return (square + 2 * jnp.einsum("np,np->n", steps, score) + bent) / windows.horizon
