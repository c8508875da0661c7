"""A field on a minibatch as functions, for tests that compare ways to evaluate it."""

from hybrid_jax.dynamics.base import as_field


def train_batch(field, x, u):
    return as_field(field).train_batch(x, u)


def infer_batch(field, x, u):
    return as_field(field).infer_batch(x, u)
