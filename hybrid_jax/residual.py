"""f_d: a fully connected network with one hidden layer and batch normalisation (paper, App. A.1)."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax.vector_field import AbstractVectorField, Statistics, evaluate_batch, observe


class InputScaling(eqx.Module):
    """Fixed affine scaling of the inputs: u ↦ (u − offset) / scale, so that they are of the size of the states."""

    offset: float = eqx.field(static=True, default=0.0)
    scale: float = eqx.field(static=True, default=1.0)

    def __call__(self, u: Float[Array, " m *b"]) -> Float[Array, " m *b"]:
        return (u - self.offset) / self.scale


class BatchNorm(eqx.Module):
    """Batch normalisation of the hidden pre-activations h = W z, with gain γ and shift β (Ioffe and Szegedy 2015).

    In training by the minibatch's mean and variance, in deployment by running ones, which fold into a map of z.
    """

    gain: Float[Array, " h"]
    shift: Float[Array, " h"]
    running: Statistics
    momentum: float = eqx.field(static=True, default=0.1)
    epsilon: float = eqx.field(static=True, default=1e-5)

    def fold(self, weight: Float[Array, "h m"]) -> tuple[Float[Array, "h m"], Float[Array, " h"]]:
        """(W', c) such that W' z + c is W z normalised by the running statistics."""
        scale = self.gain * jax.lax.rsqrt(self.running.variance + self.epsilon)
        return weight * scale[:, None], self.shift - scale * self.running.mean

    def observed(self, batch: Statistics) -> "BatchNorm":
        """The running statistics moved towards the batch's by the momentum."""
        running = jax.tree.map(lambda old, new: old + self.momentum * (new - old), self.running, batch)
        return eqx.tree_at(lambda norm: norm.running, self, running)


class ResidualNetwork(AbstractVectorField):
    """ẋ = W₂ relu(BN(W₁ z)) + b₂ with z = [x, scaled u]; 17 → 64 → 13 in the paper.

    W₁ has no bias: batch normalisation would remove it.
    """

    weight_in: Float[Array, "h m"]
    norm: BatchNorm
    weight_out: Float[Array, "d h"]
    bias_out: Float[Array, " d"]
    scaling: InputScaling = eqx.field(default_factory=InputScaling)

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        """Deployment: normalised by the running statistics."""
        weight, bias = self.norm.fold(self.weight_in)
        z = jnp.concatenate([x, self.scaling(u)])
        return self.weight_out @ jax.nn.relu(weight @ z + bias) + self.bias_out


def residual_network(
    state_size: int, input_size: int, key: PRNGKeyArray, *, hidden: int = 64, scaling: InputScaling | None = None
) -> ResidualNetwork:
    """A network with weights uniform in ±1/√fan_in, as the paper's stack initialises a linear layer."""
    key_in, key_out, key_bias = jax.random.split(key, 3)
    fan_in = state_size + input_size
    return ResidualNetwork(
        weight_in=_uniform(key_in, (hidden, fan_in), fan_in),
        norm=BatchNorm(jnp.ones(hidden), jnp.zeros(hidden), Statistics(jnp.zeros(hidden), jnp.ones(hidden))),
        weight_out=_uniform(key_out, (state_size, hidden), hidden),
        bias_out=_uniform(key_bias, (state_size,), hidden),
        scaling=InputScaling() if scaling is None else scaling,
    )


def _uniform(key: PRNGKeyArray, shape: tuple[int, ...], fan_in: int) -> Array:
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0) / fan_in**0.5


@evaluate_batch.register
def _(field: ResidualNetwork, x, u) -> Array:
    """Training: each evaluation normalises by the statistics of its own minibatch."""
    norm = field.norm
    z = jnp.concatenate([x, field.scaling(u)])
    return _normalised_layer(norm.epsilon, field.weight_in, norm.gain, norm.shift, field.weight_out, field.bias_out, z)


@observe.register
def _(field: ResidualNetwork, x, u):
    hidden = field.weight_in @ jnp.concatenate([x, field.scaling(u)])
    mean = _row_means(hidden)
    batch = Statistics(mean, _row_means(jnp.square(hidden - mean[:, None])))
    return eqx.tree_at(lambda network: network.norm, field, field.norm.observed(batch))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _normalised_layer(epsilon, weight_in, gain, shift, weight_out, bias_out, z: Float[Array, "m b"]):
    """W₂ relu(γ ĥ + β) + b₂ with ĥ = W₁ z normalised over the columns of z.

    The derivative is written out because XLA turns the sums over a minibatch that autodiff asks for into scalar loops
    on a CPU; as products with a vector of ones they halve the time of a training step. A test compares the two.
    """
    return _forward(epsilon, weight_in, gain, shift, weight_out, bias_out, z)[0]


def _forward(epsilon, weight_in, gain, shift, weight_out, bias_out, z):
    # W₁ (z − z̄) is W₁ z less its mean, and needs no subtraction of two large numbers for its variance.
    centred = z - _row_means(z)[:, None]
    hidden = weight_in @ centred
    inverse_deviation = jax.lax.rsqrt(_row_means(jnp.square(hidden)) + epsilon)
    active = jax.nn.relu((gain * inverse_deviation)[:, None] * hidden + shift[:, None])
    saved = (weight_in, gain, weight_out, centred, hidden, inverse_deviation, active)
    return weight_out @ active + bias_out[:, None], saved


def _backward(_, saved, d_out: Float[Array, "d b"]):
    weight_in, gain, weight_out, centred, hidden, inverse_deviation, active = saved
    columns = centred.shape[1]
    d_active = jnp.where(active > 0, weight_out.T @ d_out, 0.0)
    d_scale = columns * _row_means(d_active * hidden)
    # Through the scale γ r, and through r = (mean of h² + ε)^(−½).
    through_deviation = -(d_scale * gain) * inverse_deviation**3 / columns
    d_hidden = (gain * inverse_deviation)[:, None] * d_active + through_deviation[:, None] * hidden
    d_centred = weight_in.T @ d_hidden
    d_z = d_centred - _row_means(d_centred)[:, None]
    d_shift, d_bias = columns * _row_means(d_active), columns * _row_means(d_out)
    return d_hidden @ centred.T, d_scale * inverse_deviation, d_shift, d_out @ active.T, d_bias, d_z


_normalised_layer.defvjp(_forward, _backward)


def _row_means(rows: Float[Array, "r b"]) -> Float[Array, " r"]:
    return rows @ jnp.full(rows.shape[1], 1 / rows.shape[1], rows.dtype)
