"""Scaling of a network's inputs and outputs, and normalisation of its hidden units before the activation."""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial, reduce
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.batching import AbstractBatchNorm, Moments, RunningStats, expand_trailing, record_moments
from hybrid_jax.trajectories import Trajectories

UNROLLED_INPUTS = 2  # up to this many inputs, W z is a sum, because on a CPU a call of a matrix product costs more
Channels = tuple[float, ...]
Activation = Callable[[Float[Array, " h *b"]], Float[Array, " h *b"]]


class AbstractScaling(eqx.Module):
    """Scaling of a network's input [x, u] and output, which is not trained.

    Attributes:
        learned_from: some of the training windows of the network, see `standardise.with_motion`.
    """

    learned_from: Trajectories | None = eqx.field(default=None, kw_only=True)

    @abstractmethod
    def concatenate(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " n+m *b"]:
        """Return z, the scaled [x, u]."""

    def outputs(self, y: Float[Array, " d *b"]) -> Float[Array, " d *b"]:
        """Return the network's output y in units of ẋ."""
        return y


class InputScaling(AbstractScaling):
    """Scale all inputs alike, u ↦ (u − offset) / scale, but neither x nor the output. ValueError unless scale > 0.

    Attributes:
        offset: the number to subtract from each input, in its unit.
        scale: the divisor of each input, in its unit.
    """

    offset: float = eqx.field(static=True, default=0.0)
    scale: float = eqx.field(static=True, default=1.0)

    def __check_init__(self):
        checks.number("offset", self.offset)
        checks.positive("scale", self.scale)

    def concatenate(self, x, u):
        return jnp.concatenate([x, (u - self.offset) / self.scale])


class ChannelScaling(AbstractScaling):
    """z = ([x, u] − offset) / scale and ẋ = output ⊙ y, channel by channel; None means no scaling.

    `hybrid_jax.fit` sets it from the training windows; see `standardise.with_scaling`.
    """

    offset: Channels | None = eqx.field(static=True, default=None)
    scale: Channels | None = eqx.field(static=True, default=None)
    output: Channels | None = eqx.field(static=True, default=None)

    def concatenate(self, x, u):
        z = jnp.concatenate([x, u])
        if self.offset is None or self.scale is None:
            return z
        offset, scale = (expand_trailing(jnp.asarray(values, z.dtype), z) for values in (self.offset, self.scale))
        return (z - offset) / scale

    def outputs(self, y):
        return y if self.output is None else y * expand_trailing(jnp.asarray(self.output, y.dtype), y)


class AbstractNorm(eqx.Module):
    """Normalisation of the hidden pre-activations h = W z."""

    @abstractmethod
    def infer(self, weight: Float[Array, "h m"], z: Float[Array, " m *b"]) -> Float[Array, " h *b"]:
        """Return the normalised W z of each sample in inference mode."""

    def train_layers(
        self, activation: Activation, weight_in, weight_out, bias_out, z: Float[Array, "m b"]
    ) -> Float[Array, "d b"]:
        """Return W₂ σ(normalised W₁ z) + b₂ on a minibatch z, a column for each sample, in training mode."""
        return affine(weight_out, bias_out, activation(self.infer(weight_in, z)))

    def observed(self, weight: Float[Array, "h m"], z: Float[Array, "m b"]) -> Self:
        """Return the normalisation with running statistics updated by a training batch z."""
        return self


class AbstractAffineNorm(AbstractNorm):
    """A normalisation that is an affine map of z in inference mode, so that it can be folded into the weights."""

    @abstractmethod
    def fold(self, weight: Float[Array, "h m"]) -> tuple[Float[Array, "h m"], Float[Array, " h"]]:
        """Return (W', c) such that W' z + c is the normalised W z in inference mode."""

    def infer(self, weight, z):
        weight, bias = self.fold(weight)
        hidden = product(weight, z)
        return hidden + expand_trailing(bias, hidden)


class BatchNorm(AbstractAffineNorm, AbstractBatchNorm):
    """Batch normalisation of the hidden pre-activations h = W z, with gain γ and shift β (Ioffe and Szegedy 2015).

    Training uses the minibatch's mean and variance; inference uses running ones instead, folded into the weights.
    """

    gain: Float[Array, " h"]
    shift: Float[Array, " h"]
    running: RunningStats
    momentum: float = eqx.field(static=True, default=0.1)
    epsilon: float = eqx.field(static=True, default=1e-5)

    def fold(self, weight):
        scale = self.gain * jax.lax.rsqrt(self.running.variance + self.epsilon)
        return weight * scale[:, None], self.shift - scale * self.running.mean

    def train_layers(self, activation, weight_in, weight_out, bias_out, z):
        return normalised_layer(self.epsilon, activation, weight_in, self.gain, self.shift, weight_out, bias_out, z)

    def observed(self, weight, z):
        # The moments of h = W z follow from the moments of z, which is smaller. This takes a tenth of the time.
        mean = row_means(z)
        centred = z - mean[:, None]
        covariance = centred @ centred.T / z.shape[1]
        return self.moved(RunningStats(weight @ mean, jnp.sum(weight @ covariance * weight, axis=1)))

    def training_mode(self, seen: Moments):
        return MinibatchNorm(self.gain, self.shift, seen, self.epsilon)


class MinibatchNorm(AbstractNorm):
    """`BatchNorm` in training mode for one sample of a minibatch under `vmap`; see `batching`."""

    gain: Float[Array, " h"]
    shift: Float[Array, " h"]
    seen: Moments
    epsilon: float = eqx.field(static=True)

    def infer(self, weight, z):
        _, hidden, variance = record_moments(product(weight, z), self.seen)
        scale = self.gain * jax.lax.rsqrt(variance + self.epsilon)
        return expand_trailing(scale, hidden) * hidden + expand_trailing(self.shift, hidden)


class LayerNorm(AbstractNorm):
    """Layer normalisation: the h units of a sample to mean 0 and variance 1, then gain and shift (Ba et al. 2016)."""

    gain: Float[Array, " h"]
    shift: Float[Array, " h"]
    epsilon: float = eqx.field(static=True, default=1e-5)

    def infer(self, weight, z):
        hidden = weight @ z
        centred = hidden - jnp.mean(hidden, axis=0)
        normal = centred * jax.lax.rsqrt(jnp.mean(jnp.square(centred), axis=0) + self.epsilon)
        return expand_trailing(self.gain, normal) * normal + expand_trailing(self.shift, normal)


class Bias(AbstractAffineNorm):
    """No normalisation: the pre-activations plus a bias, as in a plain linear layer."""

    shift: Float[Array, " h"]

    def fold(self, weight):
        return weight, self.shift


def affine(weight: Float[Array, "d h"], bias: Float[Array, " d"], z: Float[Array, " h *b"]) -> Float[Array, " d *b"]:
    out = weight @ z
    return out + expand_trailing(bias, out)


def product(weight: Float[Array, "h m"], z: Float[Array, " m *b"]) -> Float[Array, " h *b"]:
    if len(z) > UNROLLED_INPUTS:
        return weight @ z
    return reduce(jnp.add, (expand_trailing(column, z) * row for column, row in zip(weight.T, z, strict=True)))


def normalised_layer(
    epsilon: float, activation: Activation, weight_in, gain, shift, weight_out, bias_out, z: Float[Array, "m b"]
) -> Float[Array, "d b"]:
    """Return W₂ σ(γ ĥ + β) + b₂ with ĥ = W₁ z normalised over the columns of z.

    The derivative is explicit because XLA compiles autodiff's sums over the minibatch to slow loops. As products with
    ones, they make a training step a fifth faster on a CPU without kernels. Together with the explicit derivative by
    parameters (dynamics/equations.py), sweeps on a GPU take a third less. A test compares it with autodiff.
    """
    arrays = weight_in, gain, shift, weight_out, bias_out, z
    precision = jnp.result_type(*arrays)  # each derivative is returned in the precision of its array
    return _layer(epsilon, activation, *(array.astype(precision) for array in arrays))


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _layer(*arguments):
    return _forward(*arguments)[0]


def _forward(epsilon, activation, weight_in, gain, shift, weight_out, bias_out, z):
    # W₁ (z − z̄) is W₁ z minus its mean, without subtracting two large numbers.
    centred = z - row_means(z)[:, None]
    hidden = weight_in @ centred
    inverse_deviation = jax.lax.rsqrt(row_means(jnp.square(hidden)) + epsilon)
    active = activation((gain * inverse_deviation)[:, None] * hidden + shift[:, None])
    # The active units are computed again in `_backward`, which is faster than keeping them for forty evaluations.
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


_layer.defvjp(_forward, _backward)


def _transposed(matrix: Float[Array, "r c"]) -> Float[Array, "c r"]:
    # On a CPU, a small product that reads its left factor by columns takes half as long again.
    return jax.lax.optimization_barrier(matrix.T)


def row_means(rows: Float[Array, "r b"]) -> Float[Array, " r"]:
    # On a CPU, a row times the transposed matrix takes less than half as long as the matrix times a column.
    return (jnp.full((1, rows.shape[1]), 1 / rows.shape[1], rows.dtype) @ rows.T)[0]
