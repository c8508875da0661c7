"""Batches of factorisations are done one after the other, as two at once can stop a program for ever."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybrid_jax.estimation.normal_equations import inverses
from hybrid_jax.matrices import solve

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
