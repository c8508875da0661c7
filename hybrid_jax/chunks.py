"""Evaluate a function on many windows, a few at a time, so that memory does not grow with their number."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def in_chunks(function: Callable[[Any], Any], values: Any, size: int) -> Any:
    """`function` on stacked values, `size` at a time, the last chunk padded to the same length to compile once."""
    n = len(jax.tree.leaves(values)[0])
    chunks = -(-n // size)
    length = -(-n // chunks)

    def cut(leaf):
        missing = chunks * length - n
        leaf = jnp.concatenate([leaf, jnp.repeat(leaf[-1:], missing, axis=0)]) if missing else jnp.asarray(leaf)
        return leaf.reshape(chunks, length, *leaf.shape[1:])

    found = jax.lax.map(function, jax.tree.map(cut, values))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:n], found)
