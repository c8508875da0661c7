"""The normal equations of θ_p for each window, and the effect of leaving windows out."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax.batches import in_chunks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.estimation import least_squares
from hybrid_jax.estimation.least_squares import Scale, Solver, ravel_parameters
from hybrid_jax.runtime import jit_by_size
from hybrid_jax.trajectories import Trajectories

FLAT = 1e-12  # least size of an error
CHUNK = 250  # windows in memory at a time
RANK = 10  # times p and machine epsilon: smaller eigenvalues, of parameters scaled to equal effect, count as zero


class NormalEquations(NamedTuple):
    """The normal equations of q numbers from each of n windows or records, with J the Jacobian of their errors r.

    The numbers are θ_p, or all learned numbers followed by the window's or record's own unknowns.
    """

    gram: Float[Array, "*n q q"]  # JᵀJ
    score: Float[Array, "*n q"]  # Jᵀr
    square: Float[Array, "*n"]  # rᵀr


# Compiled on its own, so that selecting a disturbance and the covariance share it.
@jit_by_size()
def normal_equations(
    field: AbstractVectorField, windows: Trajectories, solver: Solver, chunk: int, scale: Scale
) -> NormalEquations:
    """Return the normal equations of each window at a field's θ_p; for arguments see `uncertainty.covariance_of`."""
    theta, unravel = ravel_parameters(field)

    def one(window: Trajectories) -> NormalEquations:
        def errors(theta):
            r = least_squares.prediction_errors(unravel(theta), window, solver, scale)
            return r, r

        jacobian, r = jax.jacfwd(errors, has_aux=True)(theta)
        return equations_of(jacobian, r)

    return in_chunks(jax.vmap(one), windows, chunk)


def equations_of(jacobian: Float[Array, "*s q"], r: Float[Array, "*s"], robust: float = np.inf) -> NormalEquations:
    """Return the equations of one window; an error above `robust` counts linearly, not as a square (Huber 1964)."""
    effect, r = jacobian.reshape(-1, jacobian.shape[-1]), r.ravel()
    if np.isinf(robust):
        return NormalEquations(effect.T @ effect, effect.T @ r, r @ r)
    size = jnp.maximum(jnp.abs(r), FLAT)
    weighted = effect * jnp.minimum(1.0, robust / size)[:, None]
    square = jnp.where(size <= robust, r**2, 2 * robust * size - robust**2)
    return NormalEquations(weighted.T @ effect, weighted.T @ r, jnp.sum(square))


@jit_by_size()
def masked(equations: NormalEquations, free: Bool[Array | np.ndarray, " p"]) -> NormalEquations:
    """Replace the equations of parameters that are not free so that they do not change."""
    gram = jnp.where(free & free[:, None], equations.gram, jnp.diag(jnp.where(free, 0.0, 1.0)))
    return NormalEquations(gram, jnp.where(free, equations.score, 0.0), equations.square)


@jit_by_size()
def has_effect(equations: NormalEquations, windows: Trajectories, scale: Scale) -> Bool[Array, " p"]:
    """Return which parameters change the predictions by more than rounding."""
    return jnp.diagonal(jnp.sum(equations.gram, axis=0)) > jnp.square(least_squares.rounding(windows, scale))


class Inverse(NamedTuple):
    """The pseudo-inverse of JᵀJ: zero along directions that change no prediction by more than rounding."""

    matrix: Float[Array, "*n p p"]
    identified: Bool[Array, "*n p"]  # the identifiable parameters, which do not contribute to such a direction
    rank: Int[Array, "*n"]  # number of the other directions


def inverse(gram: Float[Array, "p p"], least: float | None = None) -> Inverse:
    """Invert a matrix after scaling it to a unit diagonal; `least` replaces `RANK` times p."""
    scale = jnp.sqrt(jnp.diagonal(gram))
    scale = jnp.where(scale > 0, scale, 1)
    scales = scale[:, None] * scale
    scaled, epsilon = gram / scales, jnp.finfo(gram.dtype).eps
    values, vectors = jnp.linalg.eigh(jax.lax.stop_gradient(scaled))
    seen = values > (RANK * len(gram) if least is None else least) * epsilon
    found = (vectors * jnp.where(seen, 1 / values, 0.0)) @ vectors.T
    # A step of Newton's method has the derivative of the inverse; eigenvectors' is not always finite.
    found = found @ (2 * jnp.eye(len(gram)) - scaled @ found)
    unseen = jnp.sum(jnp.where(seen, 0.0, jnp.square(vectors)), axis=1)
    return Inverse(found / scales, unseen < jnp.sqrt(epsilon), jnp.sum(seen))


def inverses(grams: Float[Array, "n p p"], least: float | None = None) -> Inverse:
    """Invert one after another, since two batches at once can deadlock, see `batches.solve`."""
    return jax.lax.map(partial(inverse, least=least), grams)


def steps_without(
    gram: Float[Array, "p p"], score: Float[Array, " p"], grams: Float[Array, "b p p"], scores: Float[Array, "b p"]
) -> Float[Array, "b p"]:
    """Compute the Gauss–Newton step without each of several parts, from the sums over all windows and these parts.

    It is not finite if a part is necessary to identify a parameter; parameters that are never identifiable do not move.
    """
    found = inverses(gram - grams)
    steps = -jnp.einsum("bpq,bq->bp", found.matrix, score - scores)
    return jnp.where((found.rank == inverse(gram).rank)[:, None], steps, jnp.nan)


def left_out(equations: NormalEquations, horizon: int) -> Float[Array, " n"]:
    """Predict L_MSE of each window by a fit of θ_p to all others (PRESS; Allen 1974), exact for linear residuals.

    It is not finite if the others identify fewer parameters than all windows do.
    """
    gram, score, square = equations
    steps = steps_without(jnp.sum(gram, axis=0), jnp.sum(score, axis=0), gram, score)
    bent = jnp.einsum("np,npq,nq->n", steps, gram, steps)
    return (square + 2 * jnp.einsum("np,np->n", steps, score) + bent) / horizon
