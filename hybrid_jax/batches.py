"""Evaluate a function on many windows, a few at a time, and solve small linear systems."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def in_chunks(function: Callable[[Any], Any], values: Any, size: int, distinct: Any = None) -> Any:
    """Evaluate `function` on n stacked values, `size` at a time, so that memory does not grow with n.

    If the values repeat the first `distinct` of them in order, only these are evaluated. The number may be traced.
    """
    n = len(jax.tree.leaves(values)[0])
    size = -(-n // -(-n // size))  # at most `size`, with few left over

    @jax.jit  # traced once for the shapes and the loop; the compiler inlines it
    def evaluated(first):
        return function(jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, size), values))

    def evaluate(i, found):
        first = jnp.minimum(i * size, n - size)
        put = partial(jax.lax.dynamic_update_slice_in_dim, start_index=first, axis=0)
        return jax.tree.map(put, found, evaluated(first.astype(jnp.int32)))

    shapes = jax.eval_shape(evaluated, jnp.int32(0))
    zeros = jax.tree.map(lambda leaf: jnp.zeros((n, *leaf.shape[1:]), leaf.dtype), shapes)
    found = jax.lax.fori_loop(0, -(-(n if distinct is None else distinct) // size), evaluate, zeros)
    return found if distinct is None else jax.tree.map(lambda leaf: leaf[jnp.arange(n) % distinct], found)


@jax.custom_batching.sequential_vmap
def solve(matrix: Float[Array, "n n"], right: Float[Array, " n *k"]) -> Float[Array, " n *k"]:
    """Solve matrix x = right for a positive definite matrix by Cholesky; under `vmap`, one system after the other.

    On a CPU, jaxlib distributes a batch of factorisations over the threads that run programs, and waits for them in one
    of these threads. Two batches at once could therefore deadlock.
    """
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), right)
