"""The normal equations of θ_p, window by window: what windows tell of it, and what leaving one out changes."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax.adaptation import least_squares
from hybrid_jax.adaptation.least_squares import Scale, Solver, ravel_parameters
from hybrid_jax.chunks import in_chunks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.programs import kept_jit
from hybrid_jax.trajectories import Trajectories

ErrorLoss = Callable[[Float[Array, " d"]], Float[Array, ""]]

CHUNK = 250  # windows in memory at a time


class NormalEquations(NamedTuple):
    """The contribution of each window to the normal equations of θ_p, with J the Jacobian of its errors r."""

    gram: Float[Array, "n p p"]  # JᵀJ
    score: Float[Array, "n p"]  # Jᵀr
    square: Float[Array, " n"]  # rᵀr


# A program of its own: selecting a disturbance and the covariance share it.
@kept_jit
def normal_equations(
    field: AbstractVectorField, windows: Trajectories, solver: Solver, chunk: int, error: ErrorLoss | None, scale: Scale
) -> NormalEquations:
    """The normal equations of each window at a field's θ_p; for arguments see `uncertainty.covariance_of`."""
    theta, unravel = ravel_parameters(field)

    def one(window: Trajectories) -> NormalEquations:
        def errors(theta):
            r = least_squares.prediction_errors(unravel(theta), window, solver, scale)
            return r, r

        jacobian, r = jax.jacfwd(errors, has_aux=True)(theta)
        return equations_of(jacobian, r, error)

    return in_chunks(jax.vmap(one), windows, chunk)


def equations_of(
    jacobian: Float[Array, "t d p"], r: Float[Array, "t d"], error: ErrorLoss | None = None
) -> NormalEquations:
    """The normal equations of one window, from its errors and their Jacobian."""
    bent, slope = jacobian, r  # half the curvature of the square times J, half its slope
    if error is not None:
        bent = jnp.einsum("tde,tep->tdp", jax.vmap(jax.hessian(error))(r), jacobian)
        slope = jax.vmap(jax.grad(error))(r)
    p = jacobian.shape[-1]
    effect, r = jacobian.reshape(-1, p), r.ravel()
    return NormalEquations(effect.T @ bent.reshape(-1, p), effect.T @ slope.ravel(), r @ r)


def masked(equations: NormalEquations, free: Bool[Array | np.ndarray, " p"]) -> NormalEquations:
    """The normal equations of the free parameters; of the others, such that they stay as they are."""
    gram = jnp.where(free & free[:, None], equations.gram, jnp.diag(jnp.where(free, 0.0, 1.0)))
    return NormalEquations(gram, jnp.where(free, equations.score, 0.0), equations.square)


def has_effect(equations: NormalEquations, windows: Trajectories, scale: Scale) -> Bool[Array, " p"]:
    """Which parameters change the predictions by more than rounding does."""
    return jnp.diagonal(jnp.sum(equations.gram, axis=0)) > jnp.square(least_squares.rounding(windows, scale))


def inverse(matrix: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """The inverse of a positive definite matrix, scaled to a unit diagonal first: parameters differ in their effect."""
    scale = jnp.sqrt(jnp.diagonal(matrix))
    scales = scale[:, None] * scale
    return jnp.linalg.inv(matrix / scales) / scales


def inverses(matrices: Float[Array, "n p p"]) -> Float[Array, "n p p"]:
    """The inverse of each, one after the other: two batches at once can wait for each other, see `matrices.solve`."""
    return jax.lax.map(inverse, matrices)


def left_out(equations: NormalEquations, horizon: int) -> Float[Array, " n"]:
    """L_MSE of each window as predicted by a fit of θ_p to all others; not finite where they do not determine θ_p.

    Solved from the normal equations at the minimum, which is exact for linear residuals (PRESS; Allen 1974).
    """
    gram, score, square = equations
    steps = -jnp.einsum("npq,nq->np", inverses(jnp.sum(gram, axis=0) - gram), jnp.sum(score, axis=0) - score)
    bent = jnp.einsum("np,npq,nq->n", steps, gram, steps)
    return (square + 2 * jnp.einsum("np,np->n", steps, score) + bent) / horizon
