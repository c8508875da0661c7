"""Batch normalisation in training mode with the layers around it, and its derivative written out.

As plain JAX for any activation, precision and device, and by the kernels of `hybrid_jax.native` where they serve.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import native
from hybrid_jax.networks.activations import ACTIVATIONS, Activation

RELU = ACTIVATIONS["relu"]


def normalised_layer(
    epsilon: float, activation: Activation, weight_in, gain, shift, weight_out, bias_out, z: Float[Array, "m b"]
) -> Float[Array, "d b"]:
    """W₂ σ(γ ĥ + β) + b₂ with ĥ = W₁ z normalised over the columns of z."""
    arrays = weight_in, gain, shift, weight_out, bias_out, z
    if _has_kernel(activation, arrays) and native.prefix():
        return _kernel_layer(epsilon, *arrays)
    precision = jnp.result_type(*arrays)  # each derivative is returned in the precision of its array
    return plain_layer(epsilon, activation, *(array.astype(precision) for array in arrays))


def _has_kernel(activation: Activation, arrays) -> bool:
    """Whether the kernels are written for this layer. They do not check shapes: what does not fit, JAX refuses."""
    (h, m), d, b = arrays[0].shape, len(arrays[4]), arrays[5].shape[1]
    fits = [array.shape for array in arrays] == [(h, m), (h,), (h,), (d, h), (d,), (m, b)]
    single = all(array.dtype == jnp.float32 for array in arrays)
    return fits and single and activation is RELU and h % native.UNITS == 0 and b >= native.VECTOR


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def plain_layer(epsilon, activation, weight_in, gain, shift, weight_out, bias_out, z: Float[Array, "m b"]):
    """W₂ σ(γ ĥ + β) + b₂ with ĥ = W₁ z normalised over the columns of z.

    The derivative is written out because XLA turns the sums over a minibatch that autodiff asks for into scalar loops
    on a CPU; as products with a vector of ones they halve the time of a training step. A test compares the two.
    """
    return _forward(epsilon, activation, weight_in, gain, shift, weight_out, bias_out, z)[0]


def _forward(epsilon, activation, weight_in, gain, shift, weight_out, bias_out, z):
    # W₁ (z − z̄) is W₁ z less its mean, and needs no subtraction of two large numbers for its variance.
    centred = z - row_means(z)[:, None]
    hidden = weight_in @ centred
    inverse_deviation = jax.lax.rsqrt(row_means(jnp.square(hidden)) + epsilon)
    active = activation((gain * inverse_deviation)[:, None] * hidden + shift[:, None])
    # The active units are computed again in `_backward`: that takes less than to keep them for forty evaluations.
    saved = (weight_in, gain, shift, weight_out, centred, hidden, inverse_deviation)
    return weight_out @ active + bias_out[:, None], saved


def _backward(_, activation, saved, d_out: Float[Array, "d b"]):
    weight_in, gain, shift, weight_out, centred, hidden, inverse_deviation = saved
    columns = centred.shape[1]
    scale = gain * inverse_deviation
    normal = scale[:, None] * hidden + shift[:, None]
    active, pullback = jax.vjp(activation, normal)
    (d_active,) = pullback(_transposed(weight_out) @ d_out)
    d_scale = columns * row_means(d_active * hidden)
    # Through the scale γ r, and through r = (mean of h² + ε)^(−½).
    through_deviation = -(d_scale * gain) * inverse_deviation**3 / columns
    d_hidden = scale[:, None] * d_active + through_deviation[:, None] * hidden
    d_centred = _transposed(weight_in) @ d_hidden
    d_z = d_centred - row_means(d_centred)[:, None]
    d_shift, d_bias = columns * row_means(d_active), columns * row_means(d_out)
    d_weight_out = d_out @ active.T
    return d_hidden @ centred.T, d_scale * inverse_deviation, d_shift, d_weight_out, d_bias, d_z


plain_layer.defvjp(_forward, _backward)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _kernel_layer(epsilon, weight_in, gain, shift, weight_out, bias_out, z: Float[Array, "m b"]):
    """`plain_layer` with ReLU, each way in one call."""
    return _forward_kernel(epsilon, weight_in, gain, shift, weight_out, bias_out, z)[0]


def _forward_kernel(epsilon, *arrays):
    def kernel(weight_in, gain, shift, weight_out, bias_out, z):
        results = _shape(bias_out, z), jax.ShapeDtypeStruct((z.size + len(gain),), z.dtype)
        arrays = weight_in, gain, shift, weight_out, bias_out, z
        return tuple(native.call("normalised_layer_forward", results, *arrays, numbers=[epsilon]))

    def plain(*arrays):
        y, (*_, centred, _, inverse_deviation) = _forward(epsilon, RELU, *arrays)
        return y, jnp.concatenate([centred.ravel(), inverse_deviation])

    y, kept = native.with_derivative(kernel, plain)(*arrays)
    return y, (*arrays[:4], kept)


def _backward_kernel(_, saved, d_out: Float[Array, "d b"]):
    def kernel(weight_in, gain, shift, weight_out, kept, d_out):
        like = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in (weight_in, gain, shift, weight_out, d_out[:, 0])]
        arrays = weight_in, gain, shift, weight_out, kept, d_out
        return tuple(native.call("normalised_layer_backward", (*like, _shape(weight_in[0], d_out)), *arrays))

    def plain(weight_in, gain, shift, weight_out, kept, d_out):
        centred, inverse_deviation = kept[: -len(gain)].reshape(-1, d_out.shape[1]), kept[-len(gain) :]
        saved = weight_in, gain, shift, weight_out, centred, weight_in @ centred, inverse_deviation
        return _backward(None, RELU, saved, d_out)

    return native.with_derivative(kernel, plain)(*saved, d_out)


_kernel_layer.defvjp(_forward_kernel, _backward_kernel)


def _shape(rows: Float[Array, " r"], columns: Float[Array, "_ b"]) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((len(rows), columns.shape[1]), columns.dtype)


def _transposed(matrix: Float[Array, "r c"]) -> Float[Array, "c r"]:
    # As a matrix of its own: a small product that reads its left factor by columns takes half as long again on a CPU.
    return jax.lax.optimization_barrier(matrix.T)


def row_means(rows: Float[Array, "r b"]) -> Float[Array, " r"]:
    """The mean of each row."""
    # A row times the transposed: on a CPU less than half of what the matrix times a column takes.
    return (jnp.full((1, rows.shape[1]), 1 / rows.shape[1], rows.dtype) @ rows.T)[0]
