"""Chunks change what a function costs, and not what it returns."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybrid_jax.chunks import in_chunks


def norms(values):
    return {"norm": jnp.linalg.norm(values, axis=1), "cube": values**3}


@pytest.mark.parametrize("size", [1, 4, 5, 7, 9])
def test_results_do_not_depend_on_the_size_of_chunks(size):
    values = np.random.default_rng(0).normal(size=(7, 2)).astype(np.float32)
    found = in_chunks(norms, values, size)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), found, norms(values))


@pytest.mark.parametrize("distinct", [1, 3, 7])
def test_values_that_repeat_are_evaluated_once(distinct):
    """What follows the first chunks is never looked at."""
    values = np.random.default_rng(0).normal(size=(distinct, 2)).astype(np.float32)
    repeated = values[np.arange(7) % distinct]
    poisoned = np.where(np.arange(7)[:, None] < -(-distinct // 3) * 3, repeated, np.nan)
    found = jax.jit(lambda many: in_chunks(norms, poisoned, 3, many))(jnp.array(distinct))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), found, norms(repeated))
