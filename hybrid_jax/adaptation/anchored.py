"""Adapt a network by few windows without losing what it knows: a ridge Gauss-Newton step from where it is.

The step minimises Σ ‖r + J δ‖² + penalty ‖δ‖² over changes δ of the network's weights in the subspace that changes the
predictions most (the leading right singular vectors of J, by randomised subspace iteration: Halko, Martinsson and
Tropp, SIAM Review 2011). The penalty holds the weights at the source's, as L2-SP does (Li, Grandvalet and Davoine,
2018). The network as it is stays among the candidates (`auto`).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from hybrid_jax.adaptation.selection import BLOCKS, BlockErrors, blocks_of, left_out_steps, predict_block
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.estimation.least_squares import Scale, Solver, prediction_errors
from hybrid_jax.estimation.starts import Starts, from_starts
from hybrid_jax.networks.mlp import ResidualNetwork
from hybrid_jax.trajectories import Trajectories

RANK = 64  # dimensions of the subspace
PENALTIES = (1.0, 1e-1, 1e-2, 1e-3)  # over the largest eigenvalue of JᵀJ
ITERATIONS = 2
TOGETHER = 8  # directions evaluated at a time


class Anchored(NamedTuple):
    """For each of k parts and c penalties the change of the weights, and how well blocks left out are predicted.

    Attributes:
        changes: of the network's weights.
        errors: on each of b blocks (k, c, b).
        removed: of the mean square of all errors, to first order.
        fitted: how many directions the penalty leaves free.
    """

    changes: Float[Array, "k c w"]
    errors: BlockErrors
    removed: Float[Array, "k c"]
    fitted: Float[Array, "k c"]


def fit_anchored(
    field: AbstractVectorField,
    windows: Trajectories,
    parts: Bool[np.ndarray, "k w"],
    solver: Solver = None,
    scale: Scale = None,
    penalties: tuple[float, ...] = PENALTIES,
    blocks: int = BLOCKS,
    starts: Starts | None = None,
) -> Anchored:
    """The steps of all penalties for some parts of the network; windows, blocks and starts as for `fit_candidates`.

    Args:
        parts: for each part which of the weights, in the order of `weights_of`, may change.
    """
    weights, _ = weights_of(field)
    places, counted = blocks_of(len(windows), blocks)
    own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[places], (windows, starts))
    smooth, weigh = from_starts(windows, starts)
    rank = min(RANK, weights.size)

    def errors(change: Float[Array, " w"]) -> Float[Array, "n e"]:
        changed = with_change(field, change)
        one = jax.vmap(lambda window: prediction_errors(changed, window, solver, scale))
        return weigh(one(smooth)).reshape(len(windows), -1)

    residuals, push = jax.linearize(errors, jnp.zeros_like(weights))
    pull = jax.linear_transpose(push, weights)

    def of_part(part: Bool[Array, " w"]):
        def iterate(_, basis):
            images = jax.lax.map(lambda direction: pull(push(direction))[0], basis, batch_size=TOGETHER)
            return part * jnp.linalg.qr(images.T)[0].T

        if rank == weights.size:  # all directions
            basis = part * jnp.eye(rank, dtype=weights.dtype)
        else:
            basis = part * jax.random.normal(jax.random.key(0), (rank, weights.size), weights.dtype)
            basis = jax.lax.fori_loop(0, ITERATIONS, iterate, basis)
        effects = jnp.moveaxis(jax.lax.map(push, basis, batch_size=TOGETHER), 0, -1)
        gram, score = jnp.einsum("ner,nes->nrs", effects, effects), jnp.einsum("ner,ne->nr", effects, residuals)
        all_gram, all_score = jnp.sum(gram, axis=0), jnp.sum(score, axis=0)
        values = jnp.maximum(jnp.linalg.eigvalsh(all_gram), 0.0)
        rows = residuals.size / windows.x0.shape[1]

        def of_penalty(penalty):
            held = penalty * values[-1] * jnp.eye(rank, dtype=gram.dtype)
            step = -jnp.linalg.solve(all_gram + held, all_score)
            removed = -(2 * all_score + all_gram @ step) @ step / rows
            fitted = jnp.sum(values / (values + penalty * values[-1]))
            without = left_out_steps(gram, score, places, counted, held) @ basis
            return step @ basis, jax.lax.map(error, (without, *own, counted)), removed, fitted

        return jax.lax.map(of_penalty, jnp.asarray(penalties, gram.dtype))

    def error(block):
        change, windows, starts, counted = block
        return predict_block(with_change(field, change), windows, starts, counted, solver, scale)

    return Anchored(*jax.lax.map(of_part, jnp.asarray(parts)))


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


def parts_of(field: AbstractVectorField) -> dict[str, Bool[np.ndarray, " w"]]:
    """The weights of the output layer, where the network is a `ResidualNetwork`, and those of the whole network."""
    assert isinstance(field, Hybrid)
    network, whole = field.residual, np.ones(weights_of(field)[0].size, bool)
    if not isinstance(network, ResidualNetwork):
        return {"network": whole}
    learned = eqx.filter(network, trainable(network))
    none = jax.tree.map(lambda leaf: np.zeros(leaf.shape), learned)
    output = (np.ones(network.weight_out.shape), np.ones(network.bias_out.shape))
    marked = eqx.tree_at(lambda found: (found.weight_out, found.bias_out), none, output)
    last = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(marked)]) > 0
    return {"last_layer": last, "network": whole}
