"""Least squares on θ_p and a constant disturbance, if the windows need one.

More parameters always fit the same windows better. Without a steady disturbance they fit errors of the network, which
does not help on the next flight. So each window is predicted by a fit to all others, with and without a disturbance
(leave-one-out cross-validation; Stone 1974), and the simpler model is kept unless it is worse by more than one standard
error of the difference (Breiman, Friedman, Olshen and Stone, Classification and Regression Trees, 1984, Sec. 3.4.3).
The fits without one window are solved from the normal equations at the minimum, which is exact for linear residuals
(PRESS; Allen 1974). Windows must be independent; the errors within one need not be.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax.adaptation.least_squares import LeastSquaresFit, Scale, Solver, fit_least_squares
from hybrid_jax.adaptation.uncertainty import inverse, normal_equations
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid
from hybrid_jax.dynamics.disturbance import (
    disturbance_of,
    physics_of,
    with_disturbance,
    with_physics,
    without_disturbance,
)
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
        windows: n independent ones.
        indices: the disturbed states, see `with_disturbance`; for the rest see `fit_least_squares`.

    Raises:
        ValueError: as `fit_least_squares`.
    """
    with_one = fit_least_squares(with_disturbance(field, indices), windows, solver, max_steps, scale)
    without = fit_least_squares(without_disturbance(field), windows, solver, max_steps, scale)
    return _selection(without, with_one, windows, solver, scale)


@eqx.filter_jit
def _selection(
    without: LeastSquaresFit, with_one: LeastSquaresFit, windows: Trajectories, solver, scale: Scale
) -> DisturbanceSelection:
    gains = left_out(without.field, windows, solver, scale) - left_out(with_one.field, windows, solver, scale)
    gain, error = jnp.mean(gains), jnp.std(gains, ddof=1) / jnp.sqrt(len(windows))
    needed = gain > error  # False where one of them is not finite
    zero = jax.tree.map(jnp.zeros_like, disturbance_of(with_one.field))
    undisturbed = with_physics(without.field, Hybrid(physics_of(without.field), zero))
    padded = eqx.tree_at(lambda fit: fit.field, without, undisturbed)
    kept = jax.tree.map(lambda a, b: jnp.where(needed, a, b) if eqx.is_array(a) else a, with_one, padded)
    return DisturbanceSelection(kept, needed, gain, error)


def left_out(
    field: AbstractVectorField, windows: Trajectories, solver: Solver = None, scale: Scale = None
) -> Float[Array, " n"]:
    """L_MSE of each window as predicted by a fit of θ_p to all others, to first order in the change of θ_p.

    Not finite where the others do not determine the parameters.

    Args:
        field: one whose θ_p minimises L_MSE of all windows.
    """
    gram, score, square = normal_equations(field, windows, solver, scale=scale)
    others = jnp.sum(gram, axis=0) - gram, jnp.sum(score, axis=0) - score
    steps = -jnp.einsum("npq,nq->np", jax.vmap(inverse)(others[0]), others[1])
    bent = jnp.einsum("np,npq,nq->n", steps, gram, steps)
    return (square + 2 * jnp.einsum("np,np->n", steps, score) + bent) / windows.horizon
