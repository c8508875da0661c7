"""The derivative of a normalised layer that is written out is that of autodiff."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybrid_jax.networks.normalisation import normalised_layer

EPSILON = 1e-5


def by_autodiff(weight_in, gain, shift, weight_out, bias_out, z):
    hidden = weight_in @ z
    normal = (hidden - hidden.mean(1, keepdims=True)) / jnp.sqrt(hidden.var(1, keepdims=True) + EPSILON)
    return weight_out @ jnp.tanh(gain[:, None] * normal + shift[:, None]) + bias_out[:, None]


@pytest.mark.parametrize("sizes", [(64, 17, 13, 100), (5, 3, 2, 2)])
def test_values_and_derivatives_are_those_of_autodiff(sizes, double_precision):
    h, m, d, b = sizes
    draw = np.random.default_rng(h + b).normal
    *arrays, d_out = (draw(size=shape) for shape in ((h, m), (h,), (h,), (d, h), (d,), (m, b), (d, b)))

    def values(function):
        y, pullback = jax.vjp(function, *arrays)
        return y, *pullback(d_out)

    ours = partial(normalised_layer, EPSILON, jnp.tanh)
    for one, other in zip(*(jax.jit(partial(values, each))() for each in (ours, by_autodiff)), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9 * np.abs(other).max())
