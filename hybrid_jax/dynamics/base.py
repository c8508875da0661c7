"""Vector fields ẋ = f(x, u): what a model is. Physics, a network, their sum and a user's own are all values of it.

A field is any Equinox module that maps one state x (d,) and one input u (m,) to ẋ (d,). Many samples are evaluated at
once, features first: x (d, b), u (m, b); by `train_batch` in training, by `infer_batch` in deployment. Both do it
by `vmap`, so a user writes code for one sample and is done. A field registers its own version when the batch means
something to it (batch normalisation), or when its code, in terms of x[0], x[1], …, serves a batch as it stands and is
twice as fast without the transposes.
"""

from abc import abstractmethod
from functools import singledispatch

import equinox as eqx
import jax
from jaxtyping import Array, Float

Batch = Float[Array, "d b"]
Columns = Float[Array, "d c"]  # derivatives of d numbers in c directions


class AbstractVectorField(eqx.Module):
    """ẋ = f(x, u) for one sample, as in deployment; every inexact array inside is learned (see `trainable`)."""

    @abstractmethod
    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        """The derivative of the state at state x under input u."""


class Hybrid(AbstractVectorField):
    """ẋ = f_p(x, u; θ_p) + f_d(x, u; θ_d): physics plus what physics leaves out (paper, Eq. 4)."""

    physics: AbstractVectorField
    residual: AbstractVectorField

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        return self.physics(x, u) + apply_residual(self.physics, x, self.residual(x, u))


class Frozen(AbstractVectorField):
    """A field that training leaves as it is: no parameter and no running statistic moves (see `unfreeze`)."""

    field: AbstractVectorField

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        return self.field(x, u)


def unfreeze(field: AbstractVectorField) -> AbstractVectorField:
    """The field without its `Frozen` wrappers."""

    def frozen(node) -> bool:
        return isinstance(node, Frozen)

    return jax.tree.map(lambda node: unfreeze(node.field) if frozen(node) else node, field, is_leaf=frozen)


@singledispatch
def train_batch(field: AbstractVectorField, x: Batch, u: Float[Array, "m b"]) -> Batch:
    """ẋ on a minibatch, as in training: features first, one column a sample."""
    return jax.vmap(field, in_axes=-1, out_axes=-1)(x, u)


@train_batch.register
def _(field: Hybrid, x, u):
    return train_batch(field.physics, x, u) + apply_residual(field.physics, x, train_batch(field.residual, x, u))


@singledispatch
def infer_batch(field: AbstractVectorField, x: Batch, u: Float[Array, "m b"]) -> Batch:
    """ẋ of many samples, each as in deployment: features first, one column a sample."""
    return jax.vmap(field, in_axes=-1, out_axes=-1)(x, u)


@infer_batch.register
def _(field: Hybrid, x, u):
    return infer_batch(field.physics, x, u) + apply_residual(field.physics, x, infer_batch(field.residual, x, u))


@infer_batch.register
def _(field: Frozen, x, u):
    return infer_batch(field.field, x, u)


@singledispatch
def apply_residual(
    field: AbstractVectorField, x: Float[Array, " d *b"], more: Float[Array, " d *b"]
) -> Float[Array, " d *b"]:
    """What another field's derivative at x adds when it acts on what this field describes: itself, unless a force shows
    in more than an acceleration, as where an estimator is slow to see it (`multirotor`).
    """
    return more


@apply_residual.register
def _(field: Hybrid, x, more):
    return apply_residual(field.physics, x, more)


@apply_residual.register
def _(field: Frozen, x, more):
    return apply_residual(field.field, x, more)


def jvp_columns(function, values: tuple, columns: tuple) -> tuple[Float[Array, " e"], Columns]:
    """The value of a function of some vectors, and its derivative in each direction of which they have a column."""
    value, slope = jax.linearize(function, *values)
    return value, jax.vmap(slope, in_axes=-1, out_axes=-1)(*columns)


@singledispatch
def linearize(
    field: AbstractVectorField, x: Float[Array, " d"], u: Float[Array, " m"], dx: Columns, du: Columns
) -> tuple[Float[Array, " d"], Columns]:
    """ẋ of one sample as in deployment, and its derivative in the directions dx (d, c), du (m, c): a pair of columns
    for each. A field that knows a shorter way than one direction after the other registers its own.
    """
    return jvp_columns(field, (x, u), (dx, du))


@linearize.register
def _(field: Hybrid, x, u, dx, du):
    alone, slope = linearize(field.physics, x, u, dx, du)
    more = linearize(field.residual, x, u, dx, du)
    added, further = jvp_columns(lambda x, more: apply_residual(field.physics, x, more), (x, more[0]), (dx, more[1]))
    return alone + added, slope + further


@linearize.register
def _(field: Frozen, x, u, dx, du):
    return linearize(field.field, x, u, dx, du)


@singledispatch
def fuse_for_inference(field: AbstractVectorField) -> AbstractVectorField:
    """The same map as in deployment, laid out to be asked for few samples at a time, hundreds of times in a row.

    The field itself, unless a faster one is registered.
    """
    return field


@fuse_for_inference.register
def _(field: Hybrid):
    return Hybrid(fuse_for_inference(field.physics), fuse_for_inference(field.residual))


@fuse_for_inference.register
def _(field: Frozen):
    return fuse_for_inference(field.field)


@singledispatch
def update_running_stats(field: AbstractVectorField, x: Batch, u: Float[Array, "m b"]) -> AbstractVectorField:
    """The field after it has seen a training batch: running statistics move, learned parameters do not."""
    return field


@update_running_stats.register
def _(field: Hybrid, x, u):
    return Hybrid(update_running_stats(field.physics, x, u), update_running_stats(field.residual, x, u))


class RunningStats(eqx.Module):
    """Running mean and variance of hidden units: state that training observes and the optimiser leaves alone."""

    mean: Float[Array, " h"]
    variance: Float[Array, " h"]


def trainable(field: AbstractVectorField) -> AbstractVectorField:
    """A tree like `field` with True at each leaf that the optimiser may move, for `equinox.partition`."""

    def fixed(node) -> bool:
        return isinstance(node, RunningStats | Frozen)

    def leaves(node):
        return False if fixed(node) else eqx.is_inexact_array(node)

    return jax.tree.map(leaves, field, is_leaf=fixed)
