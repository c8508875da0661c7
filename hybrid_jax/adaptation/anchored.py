"""Adapt a network by few windows without losing what it knows: a ridge Gauss-Newton step from where it is.

The step minimises Σ ‖r + J δ‖² + penalty ‖δ‖² over changes δ of the network's weights in the subspace that changes the
predictions most (the range of Jᵀ, from random combinations of its columns and from Jᵀr: Halko, Martinsson and Tropp,
SIAM Review 2011). The penalty holds the weights at the source's, as L2-SP does (Li, Grandvalet and Davoine,
2018). The network as it is stays among the candidates (`auto`).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from hybrid_jax.adaptation.selection import BLOCKS, BlockErrors, blocks_of, left_out_steps, predict_block
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.estimation.least_squares import Scale, Solver, prediction_errors
from hybrid_jax.estimation.starts import Starts, from_starts
from hybrid_jax.trajectories import Trajectories

RANK = 32  # dimensions of the subspace
PENALTIES = (1.0, 1e-1, 1e-2, 1e-3)  # over the largest eigenvalue of JᵀJ
TOGETHER = 8  # directions evaluated at a time


class Anchored(NamedTuple):
    """For each of c penalties the change of the weights, and how well blocks that are left out are predicted.

    Attributes:
        changes: of the network's weights.
        errors: on each of b blocks (c, b).
        removed: of the mean square of all errors, to first order.
        fitted: how many directions the penalty leaves free.
    """

    changes: Float[Array, "c w"]
    errors: BlockErrors
    removed: Float[Array, " c"]
    fitted: Float[Array, " c"]


def fit_anchored(
    field: AbstractVectorField,
    windows: Trajectories,
    solver: Solver = None,
    scale: Scale = None,
    penalties: tuple[float, ...] = PENALTIES,
    blocks: int = BLOCKS,
    starts: Starts | None = None,
) -> Anchored:
    """The steps of all penalties; windows, blocks and starts as for `fit_candidates`."""
    weights, _ = weights_of(field)
    places, counted = blocks_of(len(windows), blocks)
    own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[places], (windows, starts))
    smooth, weigh = from_starts(windows, starts)

    def errors(change: Float[Array, " w"]) -> Float[Array, "n e"]:
        changed = with_change(field, change)
        one = jax.vmap(lambda window: prediction_errors(changed, window, solver, scale))
        return weigh(one(smooth)).reshape(len(windows), -1)

    def seen(key) -> Float[Array, " w"]:
        return pull(jax.random.normal(key, residuals.shape, residuals.dtype))[0]

    residuals, push = jax.linearize(errors, jnp.zeros_like(weights))
    pull = jax.linear_transpose(push, weights)
    if weights.size <= RANK:  # all directions
        basis = jnp.eye(weights.size, dtype=weights.dtype)
    else:
        images = jax.lax.map(seen, jax.random.split(jax.random.key(0), RANK - 1), batch_size=TOGETHER)
        basis = jnp.linalg.qr(jnp.concatenate([images, *(part[None] for part in pull(residuals))]).T)[0].T
    effects = jnp.moveaxis(jax.lax.map(push, basis, batch_size=TOGETHER), 0, -1)
    gram, score = jnp.einsum("ner,nes->nrs", effects, effects), jnp.einsum("ner,ne->nr", effects, residuals)
    all_gram, all_score = jnp.sum(gram, axis=0), jnp.sum(score, axis=0)
    values = jnp.maximum(jnp.linalg.eigvalsh(all_gram), 0.0)

    def of_penalty(penalty):
        held = penalty * values[-1] * jnp.eye(len(basis), dtype=gram.dtype)
        step = -jnp.linalg.solve(all_gram + held, all_score)
        without = left_out_steps(gram, score, places, counted, held) @ basis
        removed = -(2 * all_score + all_gram @ step) @ step * windows.x0.shape[1] / residuals.size
        fitted = jnp.sum(values / (values + penalty * values[-1]))
        return step @ basis, jax.lax.map(error, (without, *own, counted)), removed, fitted

    def error(block):
        change, windows, starts, counted = block
        return predict_block(with_change(field, change), windows, starts, counted, solver, scale)

    return Anchored(*jax.lax.map(of_penalty, jnp.asarray(penalties, gram.dtype)))


def with_change(field: AbstractVectorField, change: Float[Array, " w"]) -> AbstractVectorField:
    """The field with a change added to the weights of its network."""
    weights, unravel = weights_of(field)
    return eqx.tree_at(lambda hybrid: hybrid.residual, field, unravel(weights + change))


def weights_of(field: AbstractVectorField) -> tuple[Float[Array, " w"], Callable[[Float[Array, " w"]], PyTree]]:
    """The trainable weights of the network as a vector, and the network as a function of it."""
    assert isinstance(field, Hybrid)
    learned, rest = eqx.partition(field.residual, trainable(field.residual))
    weights, unravel = ravel_pytree(learned)
    return weights, lambda changed: eqx.combine(unravel(changed), rest)
