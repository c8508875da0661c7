"""Batches of factorisations, done one after the other as two at once can stop a program for ever; and chunks."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybrid_jax.batches import in_chunks, solve
from hybrid_jax.estimation.normal_equations import inverses

ROOTS = np.random.default_rng(0).normal(size=(4, 3, 3)).astype(np.float32)
POSITIVE, RIGHT = ROOTS @ ROOTS.swapaxes(1, 2) + np.eye(3, dtype=np.float32), np.ones((4, 3, 2), np.float32)


@pytest.mark.parametrize(
    ("function", "arguments", "expected"),
    [
        (jax.vmap(solve), (POSITIVE, RIGHT), np.linalg.solve(POSITIVE, RIGHT)),
        (lambda grams: inverses(grams).matrix, (POSITIVE,), np.linalg.inv(POSITIVE)),
    ],
)
def test_no_batch_is_factored_at_once(function, arguments, expected):
    np.testing.assert_allclose(function(*arguments), expected, atol=1e-4)
    calls = [line for line in jax.jit(function).lower(*arguments).as_text().splitlines() if "lapack" in line]
    assert calls
    assert not any("4x3x3" in line for line in calls), calls


def test_a_derivative_goes_through_an_inverse():
    slope = jax.grad(lambda scale: jnp.sum(inverses(scale * POSITIVE).matrix))(2.0)
    np.testing.assert_allclose(slope, -np.linalg.inv(POSITIVE).sum() / 4, rtol=1e-4)


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
