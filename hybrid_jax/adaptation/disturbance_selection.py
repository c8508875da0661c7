"""Least squares on θ_p and a constant disturbance, if the windows need one.

More parameters always fit the same windows better. Without a steady disturbance they fit errors of the network, which
does not help on the next flight. So each window is predicted by a fit to all others, with and without a disturbance
(leave-one-out cross-validation; Stone 1974), and the simpler model is kept unless it is worse by more than one standard
error of the difference (Breiman, Friedman, Olshen and Stone, Classification and Regression Trees, 1984, Sec. 3.4.3).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax.adaptation.least_squares import LeastSquaresFit, Scale, Solver, fit_least_squares
from hybrid_jax.adaptation.uncertainty import CHUNK, NormalEquations, inverse, normal_equations
from hybrid_jax.dynamics import disturbance
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid
from hybrid_jax.trajectories import Trajectories


class DisturbanceSelection(eqx.Module):
    """The fit that was kept, with a disturbance of zero if none is needed, and why."""

    fit: LeastSquaresFit
    needed: Bool[Array, ""]
    gain: Float[Array, ""]  # by how much a disturbance lowers L_MSE of left-out windows, mean over windows
    standard_error: Float[Array, ""]  # of the gain


def select_disturbance(
    field: AbstractVectorField,
    windows: Trajectories,
    solver: Solver = None,
    max_steps: int = 100,
    scale: Scale = None,
    indices: tuple[int, ...] | None = None,
) -> DisturbanceSelection:
    """Fit θ_p with and without a constant disturbance and keep the fit that predicts left-out windows better.

    Pure, as `fit_least_squares`. A single window, or windows that do not determine the parameters, need no disturbance.

    Args:
        windows: independent ones; the errors within one need not be.
        indices: the disturbed states, see `with_disturbance`.

    For the rest, and ValueErrors, see `fit_least_squares`.
    """
    starts = disturbance.with_disturbance(field, indices), disturbance.without_disturbance(field)
    fits = [fit_least_squares(start, windows, solver, max_steps, scale) for start in starts]
    equations = [normal_equations(fit.field, windows, solver, CHUNK, None, scale) for fit in fits]
    return _selection(fits, equations, windows.horizon)


@eqx.filter_jit
def _selection(fits: list[LeastSquaresFit], equations: list[NormalEquations], horizon: int) -> DisturbanceSelection:
    disturbed, plain = fits
    gains = left_out(equations[1], horizon) - left_out(equations[0], horizon)
    gain, error = jnp.mean(gains), jnp.std(gains, ddof=1) / jnp.sqrt(len(gains))
    needed = gain > error  # False where one of them is not finite
    zero = jax.tree.map(jnp.zeros_like, disturbance.disturbance_of(disturbed.field))
    padded = disturbance.with_physics(plain.field, Hybrid(disturbance.physics_of(plain.field), zero))
    plain = eqx.tree_at(lambda fit: fit.field, plain, padded)
    kept = jax.tree.map(lambda a, b: jnp.where(needed, a, b) if eqx.is_array(a) else a, disturbed, plain)
    return DisturbanceSelection(kept, needed, gain, error)


def left_out(equations: NormalEquations, horizon: int) -> Float[Array, " n"]:
    """L_MSE of each window as predicted by a fit of θ_p to all others; not finite where they do not determine θ_p.

    Solved from the normal equations at the minimum, which is exact for linear residuals (PRESS; Allen 1974).
    """
    gram, score, square = equations
    others = jnp.sum(gram, axis=0) - gram, jnp.sum(score, axis=0) - score
    steps = -jnp.einsum("npq,nq->np", jax.vmap(inverse)(others[0]), others[1])
    bent = jnp.einsum("np,npq,nq->n", steps, gram, steps)
    return (square + 2 * jnp.einsum("np,np->n", steps, score) + bent) / horizon
