"""Evaluate a single-sample field on a minibatch, with batch normalisation over the named axis of its `vmap`."""

from abc import abstractmethod
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

SAMPLES = "samples"  # the axis of a minibatch

Batch = Float[Array, "d b"]
Moments = Float[Array, "3 h"]  # number of evaluations, sum of their means, sum of their variances


class RunningStats(eqx.Module):
    """Running mean and variance of hidden units. They are updated in training, but not by the optimiser."""

    mean: Float[Array, " h"]
    variance: Float[Array, " h"]


class AbstractBatchNorm(eqx.Module):
    """A layer that normalises by the minibatch in training and by running statistics in inference."""

    running: eqx.AbstractVar[RunningStats]
    momentum: eqx.AbstractVar[float]

    @abstractmethod
    def training_mode(self, seen: Moments) -> eqx.Module:
        """Return the layer for one sample of a minibatch, which calls `record_moments(_, seen)`."""

    def moved(self, batch: RunningStats) -> Self:
        """Return this layer with running statistics moved towards the minibatch's by the momentum."""
        move = self.momentum
        running = jax.tree.map(lambda old, new: (old + move * (new - old)).astype(old.dtype), self.running, batch)
        return eqx.tree_at(lambda norm: norm.running, self, running)


class AbstractInferenceOnly(eqx.Module):
    """A module that training neither changes nor evaluates in training mode."""


def over_samples(function):
    """Apply `function` to all samples of a minibatch, along the last axis of its arguments and its result."""
    return jax.vmap(function, in_axes=-1, out_axes=-1, axis_name=SAMPLES)


def expand_trailing(values: Float[Array, " r"], rows: Float[Array, " _ *b"]) -> Float[Array, " r *b"]:
    """Add a trailing axis of length 1 to the values for each batch axis of `rows`."""
    return jnp.reshape(values, values.shape + (1,) * (rows.ndim - 1))


def batch_norms(tree: PyTree) -> list[AbstractBatchNorm]:
    """Return all layers of batch normalisation that are evaluated in training."""
    return [node for node in jax.tree.leaves(tree, is_leaf=_stops) if isinstance(node, AbstractBatchNorm)]


def like(tree: PyTree, leader: Float[Array, "..."]) -> PyTree:
    """Return the tree, batched under `vmap` if the leader is. With such an initial carry, JAX traces a scan once."""
    number = jnp.ravel(leader)[0]
    return jax.tree.map(lambda leaf: jnp.where(number > 0, leaf, leaf), tree)


def _unseen(tree: PyTree) -> list[Moments]:
    shapes = (norm.running.mean for norm in batch_norms(tree))
    return [jnp.zeros((3, *mean.shape), mean.dtype) for mean in shapes]


def training_mode(tree: PyTree, seen: list[Moments] | None = None) -> PyTree:
    seen = _unseen(tree) if seen is None else seen
    return _replaced(tree, [norm.training_mode(one) for norm, one in zip(batch_norms(tree), seen, strict=True)])


def moments_of(field, x, u) -> list[Moments]:
    """Return the moments that each `AbstractBatchNorm` records on a minibatch, x (d, b) and u (m, b).

    They are the derivative with respect to an input without effect (`_record`). Derivatives add up through any jit,
    scan or vmap around the layer, whereas values stored during tracing would leak.
    """
    slope, pullback = jax.vjp(lambda seen: over_samples(training_mode(field, seen))(x, u), _unseen(field))
    return pullback(jnp.zeros_like(slope))[0]


def with_moved_stats(field, x: Batch, u: Float[Array, "m b"]):
    """Return the field with running statistics moved by a minibatch; several evaluations of a layer are averaged."""
    if not (norms := batch_norms(field)):
        return field

    def moved(norm: AbstractBatchNorm, seen: Moments) -> AbstractBatchNorm:
        before = jnp.stack([norm.running.mean, norm.running.variance])
        return norm.moved(RunningStats(*jnp.where(seen[0] > 0, seen[1:] / seen[0], before)))

    return _replaced(field, list(map(moved, norms, moments_of(field, x, u))))


def record_moments(hidden: Float[Array, " h *a"], seen: Moments):
    """Return mean, centred values and variance over all axes but the first and the minibatch; record them in `seen`."""

    def centre(hidden):
        mean = jax.lax.pmean(jnp.mean(hidden, axis=tuple(range(1, hidden.ndim))), SAMPLES)
        return mean, hidden - expand_trailing(mean, hidden)

    mean, centred = centre(hidden)
    variance, _ = centre(jnp.square(centred))
    moments = jnp.stack([jnp.ones_like(mean), mean, variance]).astype(seen.dtype)
    return mean, _record(centred, seen, moments), variance


@jax.custom_vjp
def _record(hidden: Float[Array, " h *a"], seen: Moments, moments: Moments) -> Float[Array, " h *a"]:
    """Return `hidden`; in reverse mode, add the moments to the derivative with respect to `seen`."""
    return hidden


_record.defvjp(
    lambda hidden, seen, moments: (hidden, moments),
    lambda moments, d_hidden: (d_hidden, moments, jnp.zeros_like(moments)),
)


def _stops(node) -> bool:
    return isinstance(node, AbstractBatchNorm | AbstractInferenceOnly)


def _replaced(tree: PyTree, norms: list) -> PyTree:
    left = iter(norms)
    return jax.tree.map(lambda n: next(left) if isinstance(n, AbstractBatchNorm) else n, tree, is_leaf=_stops)
