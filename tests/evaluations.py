"""A field on a minibatch as functions, each one program, for tests that compare ways to evaluate it."""

import equinox as eqx

from hybrid_jax.dynamics.base import as_field


@eqx.filter_jit
def train_batch(field, x, u):
    return as_field(field).train_batch(x, u)


@eqx.filter_jit
def infer_batch(field, x, u):
    return as_field(field).infer_batch(x, u)
