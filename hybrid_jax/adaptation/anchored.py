"""Adapt a network to few windows by one ridge Gauss–Newton step from the source's weights, and measure its effect.

The step minimises Σ ‖r + J δ‖² + penalty ‖δ‖² over δ in a random subspace of the range of Jᵀ (Halko, Martinsson and
Tropp, SIAM Review 2011), with the penalty of largest evidence (L2-SP; Li, Grandvalet and Davoine 2018).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from hybrid_jax.adaptation.selection import TINY, left_out_steps
from hybrid_jax.batches import in_chunks
from hybrid_jax.dynamics.base import AbstractVectorField, ravel_learned, trainable
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.disturbance import disturbance_units, physics_of
from hybrid_jax.estimation.least_squares import Scale, Solver, prediction_errors, ravel_parameters
from hybrid_jax.estimation.normal_equations import CHUNK, NormalEquations, inverse
from hybrid_jax.estimation.starts import Starts, from_starts
from hybrid_jax.runtime import UNOPTIMISED, jit_by_size
from hybrid_jax.trajectories import Trajectories, errors_of

RANK = 32  # dimensions of the subspace
PENALTIES = (1.0, 1e-1, 1e-2, 1e-3)  # over the largest eigenvalue of JᵀJ
TOGETHER = 8  # directions evaluated at a time


class Anchored(NamedTuple):
    """The step with the best penalty."""

    change: Float[Array, " w"]  # of the network's weights
    left_out: Float[Array, "b w"]  # the change that is fitted without each block of windows
    odds: Float[Array, ""]  # evidence of the best step over no step
    naive: Float[Array, ""]  # the same odds if the source had no errors


class Subspace(NamedTuple):
    """A subspace of k directions of the network's weights, and their effects on the e errors of n windows."""

    basis: Float[Array, "k w"]
    effects: Float[Array, "n e k"]
    errors: Float[Array, "n e"]


def subspace(
    field: AbstractVectorField, windows: Trajectories, starts: Starts | None, solver: Solver, scale: Scale
) -> Subspace:
    """Linearise the errors in the network's weights along random directions in the range of Jᵀ."""
    weights, _ = weights_of(field)
    smooth, weigh = from_starts(windows, starts)

    def errors(change: Float[Array, " w"]) -> Float[Array, "n e"]:
        changed: Any = eqx.filter_checkpoint(with_change(field, change))
        one = jax.vmap(lambda window: prediction_errors(changed, window, solver, scale))
        return weigh(one(smooth)).reshape(len(windows), -1)

    def seen(key) -> Float[Array, " w"]:
        return pull(jax.random.normal(key, residuals.shape, residuals.dtype))[0]

    residuals, push = jax.linearize(errors, jnp.zeros_like(weights))
    pull = jax.linear_transpose(push, weights)
    if weights.size <= RANK:  # all directions
        basis = jnp.eye(weights.size, dtype=weights.dtype)
    else:
        images = jax.lax.map(seen, jax.random.split(jax.random.key(0), RANK), batch_size=TOGETHER)
        basis = jnp.linalg.qr(images.T)[0].T
    effects = jnp.moveaxis(jax.lax.map(push, basis, batch_size=TOGETHER), 0, -1)
    return Subspace(basis, effects, residuals)


def fit_anchored(found: Subspace, noise: Float[Array, ""], error: Float[Array, ""], blocks, left_out) -> Anchored:
    """Choose a penalty by the variance between `blocks`, and compute its step; for `error` see `Unchanged`."""
    basis, effects, residuals = found
    gram, score = jnp.einsum("ner,nes->nrs", effects, effects), jnp.einsum("ner,ne->nr", effects, residuals)
    values, vectors = jnp.linalg.eigh(jnp.sum(gram, axis=0))
    values = jnp.maximum(values, jnp.maximum(1e-6 * values[-1], TINY))
    along = score @ vectors  # of each window
    places, counted = blocks
    of_blocks = jnp.sum(along[places] * counted[..., None], axis=1)
    away, counts = of_blocks - jnp.mean(of_blocks, axis=0), values > 2e-6 * values[-1]
    variance = jnp.sum(jnp.where(counts, jnp.square(away) / values, 0.0)) / jnp.sum(counts)
    variance = jnp.maximum(variance * len(places) / max(len(places) - 1, 1), jnp.maximum(noise, TINY))
    information, pull = values / variance, jnp.sum(along, axis=0) / variance

    def evidence(size: Float[Array, " r"]) -> Float[Array, ""]:
        spread = 1 + size * information
        return 0.5 * jnp.sum(size * jnp.square(pull) / spread - jnp.log(spread))

    penalties = jnp.asarray(PENALTIES, gram.dtype)
    sizes = jnp.broadcast_to(1 / (penalties * information[-1]), (len(values), len(penalties))).T
    apparent = error / values  # each direction could explain the whole error
    evidences = jax.vmap(evidence)(jnp.concatenate([sizes + apparent, sizes, apparent[None]]))
    with_both, naive = jnp.split(evidences[:-1], 2)
    best = jnp.argmax(with_both)
    held, share = penalties[best] * values[-1], sizes[best] / (sizes[best] + apparent)
    step = -vectors @ (share * jnp.sum(along, axis=0) / (values + held))
    held = held * jnp.eye(len(basis), dtype=gram.dtype)
    without = left_out_steps(NormalEquations(gram, score, score[:, 0]), held, jnp.zeros_like(step), left_out)
    without = (without @ vectors * share) @ vectors.T
    odds, naive = jnp.exp(jnp.minimum(jnp.stack([with_both[best] - evidences[-1], jnp.max(naive)]), 80.0))
    return Anchored(step @ basis, without @ basis, odds, naive)


def with_change(field: AbstractVectorField, change: Float[Array, " w"]) -> AbstractVectorField:
    weights, unravel = weights_of(field)
    return eqx.tree_at(lambda hybrid: hybrid.residual, field, unravel(weights + change))


def has_network(field: AbstractVectorField) -> bool:
    """Return whether a field is a hybrid with a trainable residual other than a disturbance."""
    learned = isinstance(field, Hybrid) and any(jax.tree.leaves(trainable(field.residual)))
    return learned and physics_of(field) is not field


def weights_of(field: AbstractVectorField) -> tuple[Float[Array, " w"], Callable[[Float[Array, " w"]], PyTree]]:
    """Return the network's trainable weights as a vector, and the network as a function of it."""
    assert isinstance(field, Hybrid)
    return ravel_learned(field.residual)


class Effect(NamedTuple):
    """The network's effect b on the predictions of n windows."""

    total: Float[Array, ""]  # ‖b‖² over all windows and states
    score: Float[Array, "n p"]  # Jᵀ b of each window, with the Jacobian J in θ_p, less what another start explains


@jit_by_size(UNOPTIMISED)
def network_effect(
    field: AbstractVectorField, windows: Trajectories, starts: Starts | None, solver: Solver, scale: Scale
) -> Effect:
    (theta, unravel), (weights, _) = ravel_parameters(field), weights_of(field)

    def of_windows(part: tuple[Trajectories, Starts | None]) -> tuple[Float[Array, " c"], Float[Array, "c p"]]:
        smooth, weigh = from_starts(*part)

        def errors(thetas: Float[Array, "c p"], change: Float[Array, " w"]):
            def one(theta, window):
                found = prediction_errors(with_change(unravel(theta), change), window, solver, scale)
                held = -errors_of(jnp.broadcast_to(window.x0, window.x.shape), window.x)
                held = held if scale is None else held / scale
                # Without its network a model may diverge: then its prediction is the start.
                return jnp.where(jnp.isfinite(jnp.sum(jnp.square(found))), found, held.astype(found.dtype))

            found = jax.vmap(one)(thetas, smooth)
            return weigh(found), found

        thetas = jnp.broadcast_to(theta, (len(smooth.x), len(theta)))
        weighted, pull, there = jax.vjp(lambda thetas: errors(thetas, jnp.zeros_like(weights)), thetas, has_aux=True)
        weighted_without, without = errors(thetas, -weights)
        return jnp.sum(jnp.square(there - without), axis=(1, 2)), pull(weighted - weighted_without)[0]

    total, score = in_chunks(of_windows, (windows, starts), CHUNK)
    return Effect(jnp.sum(total), score)


def quantities_of(field: AbstractVectorField, windows: Trajectories) -> int:
    """Return on how many quantities an effect that physics lacks may depend.

    Aerodynamic forces depend, for example, on the velocity, the body rates and the rotor speeds.
    """
    return len(disturbance_units(field)) + windows.u.shape[-1]


def taken_by_network(
    equations: NormalEquations,
    score: Float[Array, "n p"],
    blocks: tuple[Int[np.ndarray, "b m"], Bool[np.ndarray, "b m"]],
) -> Float[Array, " p"]:
    """Compute each parameter's variance due to effects that the network represents and physics may have.

    A block of windows with the network's effect b on its predictions moves the fit by m = H⁻¹ Jᵀ b and has the share
    w = H⁻¹ H_b H⁻¹ of the covariance H⁻¹, so it says that parameter j is wrong by m_j (H⁻¹)_jj / w_jj. The variance is
    the mean square of this over blocks, weighted by w_jj. It is not the mean that counts: physics that was fitted
    before the network leaves no effect in the mean, but what physics lacks, for example ground effect, is not the same
    everywhere.

    Args:
        equations: normal equations of each window for the fitted parameters; H is the sum of their matrices.
        score: Jᵀ b of each window, see `Effect`.
        blocks: window indices of each block and which count, see `selection.blocks_of`.
    """
    places, counted = blocks
    matrix = inverse(jnp.sum(equations.gram, axis=0)).matrix
    gram = jnp.sum(equations.gram[places] * counted[..., None, None], axis=1)
    score = jnp.sum(score[places] * counted[..., None], axis=1)
    weights = jnp.maximum(jnp.einsum("pq,bqr,rp->bp", matrix, gram, matrix), TINY)
    return jnp.diagonal(matrix) * jnp.sum(jnp.square(score @ matrix) / weights, axis=0)


def without_network(field: AbstractVectorField) -> AbstractVectorField:
    weights, unravel = weights_of(field)
    return eqx.tree_at(lambda hybrid: hybrid.residual, field, unravel(jnp.zeros_like(weights)))
