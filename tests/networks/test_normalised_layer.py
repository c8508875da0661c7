"""The kernels of a network's layers do what JAX does, and JAX does it where they cannot be had."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybrid_jax import native
from hybrid_jax.networks import normalised_layer as layers

EPSILON = 1e-5
PLAIN = partial(layers.plain_layer, EPSILON, layers.RELU)
# h, m, d, b: the paper's, whose samples are no multiple of a vector; one vector of samples; few inputs and many.
SIZES = [(64, 17, 13, 100), (64, 17, 13, 16), (32, 3, 2, 33), (96, 40, 20, 101), (32, 16, 16, 64)]
CACHED = native._compiled, native._obstacle, native._digest

needs_kernels = pytest.mark.skipif(native.prefix() is None, reason=native.status())


def layer(h, m, d, b, lanes=()):
    """The arrays of a layer, and a derivative of its result."""
    draw = np.random.default_rng(h + b).normal
    shapes = (h, m), (h,), (h,), (d, h), (d,), (m, b), (d, b)
    *arrays, d_out = (draw(size=(*lanes, *shape)).astype(np.float32) for shape in shapes)
    return arrays, d_out


def both_ways(function, arrays, d_out):
    y, pullback = jax.vjp(function, *arrays)
    return y, *pullback(d_out)


@pytest.fixture
def anew():
    """Nothing is known of kernels, before and after."""
    for function in CACHED:
        function.cache_clear()
    yield
    for function in CACHED:
        function.cache_clear()


@needs_kernels
@pytest.mark.parametrize("sizes", SIZES)
def test_values_and_derivatives_are_those_of_jax_in_double_precision(sizes):
    arrays, d_out = layer(*sizes)
    found = jax.jit(partial(both_ways, partial(layers._kernel_layer, EPSILON)))(arrays, d_out)
    with jax.enable_x64(True):
        exact = both_ways(PLAIN, *jax.tree.map(lambda part: part.astype(float), (arrays, d_out)))
        for one, other in zip(found, exact, strict=True):
            # Sums of up to a hundred products, each of which is rounded at 6e-8.
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-6 * np.abs(other).max())


@needs_kernels
def test_a_lane_is_the_same_alone_to_the_bit():
    lanes = layer(32, 17, 13, 40, lanes=(2, 3))
    function = partial(both_ways, partial(layers._kernel_layer, EPSILON))
    together = jax.jit(jax.vmap(jax.vmap(function)))(*lanes)
    alone = jax.jit(function)(*jax.tree.map(lambda part: part[1, 2], lanes))
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_array_equal(one[1, 2], other)


@needs_kernels
def test_weights_that_are_no_numbers_show_in_the_result():
    # Or a run that diverged would go on.
    (weight, *others), _ = layer(32, 3, 2, 20)
    weight[5, 1] = np.nan
    assert np.isnan(layers._kernel_layer(EPSILON, weight, *others)).all()


@needs_kernels
def test_a_second_derivative_is_that_of_jax():
    arrays, d_out = layer(32, 3, 2, 20)

    def curvature(function, z):
        slope = jax.grad(lambda z: jnp.sum(d_out * jnp.square(function(*arrays[:-1], z))))
        return jax.grad(lambda z: jnp.sum(jnp.square(slope(z))))(z)

    found, expected = (curvature(function, arrays[-1]) for function in (partial(layers._kernel_layer, EPSILON), PLAIN))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


OTHER = {
    "precision": lambda arrays: [jnp.asarray(part, jnp.float16) for part in arrays],
    "units": lambda arrays: [arrays[0][:20], *(part[:20] for part in arrays[1:3]), arrays[3][:, :20], *arrays[4:]],
    "samples": lambda arrays: [*arrays[:-1], arrays[-1][:, :9]],
}


@pytest.mark.parametrize("change", OTHER.values(), ids=OTHER)
def test_other_layers_are_plain_jax(change):
    arrays = change(layer(32, 5, 3, 20)[0])
    found = layers.normalised_layer(EPSILON, layers.RELU, *arrays)
    np.testing.assert_array_equal(found, PLAIN(*arrays))


def test_other_activations_are_plain_jax():
    arrays, _ = layer(32, 5, 3, 20)
    found = layers.normalised_layer(EPSILON, jnp.tanh, *arrays)
    np.testing.assert_array_equal(found, layers.plain_layer(EPSILON, jnp.tanh, *arrays))


def test_arrays_that_do_not_fit_are_refused():
    arrays, _ = layer(32, 5, 3, 20)
    with pytest.raises(TypeError):
        layers.normalised_layer(EPSILON, layers.RELU, *arrays[:-1], arrays[-1][:4])


WITHOUT = {
    "switched off": ({native.SWITCH: "0"}, "HYBRID_JAX_NATIVE is 0"),
    "no compiler": ({"CXX": "no-such-compiler"}, "no g++"),
    "a compiler that fails": ({"CXX": "false"}, "could not be compiled"),
}


@needs_kernels
@pytest.mark.parametrize(("variables", "reason"), WITHOUT.values(), ids=WITHOUT)
def test_without_kernels_jax_does_the_same(variables, reason, anew, tmp_path, monkeypatch):
    for name, value in (variables | {"XDG_CACHE_HOME": str(tmp_path)}).items():
        monkeypatch.setenv(name, value)
    arrays, _ = layer(32, 3, 2, 20)
    np.testing.assert_array_equal(layers.normalised_layer(EPSILON, layers.RELU, *arrays), PLAIN(*arrays))
    assert reason in native.status()
    assert not list(tmp_path.rglob("*.so"))
