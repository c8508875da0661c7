"""What is done to hidden units before the ReLU: batch normalisation (paper, App. A.1), layer normalisation, a bias.

Layer normalisation, or none, stands in for batch normalisation where a network should be the same map in training and
in deployment.
"""

from abc import abstractmethod
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import Batch, RunningStats
from hybrid_jax.networks.batchnorm_vjp import normalised_layer, row_means

FEW = 2  # inputs


class Normalisation(eqx.Module):
    """What is done to the hidden pre-activations h = W z before the ReLU."""

    @abstractmethod
    def deployed(self, weight: Float[Array, "h m"], z: Float[Array, " m *b"]) -> Float[Array, " h *b"]:
        """The normalised W z of each sample, as in deployment."""

    @abstractmethod
    def layers(
        self, weight_in: Float[Array, "h m"], weight_out: Float[Array, "d h"], bias_out: Float[Array, " d"], z: Batch
    ) -> Batch:
        """W₂ relu(normalised W₁ z) + b₂ on a minibatch z (m, b), as in training."""

    @abstractmethod
    def observed(self, hidden: Float[Array, "h b"]) -> "Normalisation":
        """This after it has seen the pre-activations of a training batch."""


class AffineNorm(Normalisation):
    """One that is an affine map of z as deployed, which weights can hold."""

    @abstractmethod
    def fold(self, weight: Float[Array, "h m"]) -> tuple[Float[Array, "h m"], Float[Array, " h"]]:
        """(W', c) such that W' z + c is the normalised W z, as deployed."""

    def deployed(self, weight, z):
        weight, bias = self.fold(weight)
        hidden = product(weight, z)
        return hidden + beside(bias, hidden)


class BatchNorm(AffineNorm):
    """Batch normalisation of the hidden pre-activations h = W z, with gain γ and shift β (Ioffe and Szegedy 2015).

    In training by the minibatch's mean and variance, in deployment by running ones, which fold into a map of z.
    """

    gain: Float[Array, " h"]
    shift: Float[Array, " h"]
    running: RunningStats
    momentum: float = eqx.field(static=True, default=0.1)
    epsilon: float = eqx.field(static=True, default=1e-5)

    def fold(self, weight):
        scale = self.gain * jax.lax.rsqrt(self.running.variance + self.epsilon)
        return weight * scale[:, None], self.shift - scale * self.running.mean

    def layers(self, weight_in, weight_out, bias_out, z):
        return normalised_layer(self.epsilon, weight_in, self.gain, self.shift, weight_out, bias_out, z)

    def observed(self, hidden):
        """The running statistics moved towards the batch's by the momentum."""
        mean = row_means(hidden)
        batch = RunningStats(mean, row_means(jnp.square(hidden - mean[:, None])))
        running = jax.tree.map(lambda old, new: old + self.momentum * (new - old), self.running, batch)
        return eqx.tree_at(lambda norm: norm.running, self, running)


class LayerNorm(Normalisation):
    """Layer normalisation: the h units of a sample to mean 0 and variance 1, then gain and shift (Ba et al. 2016)."""

    gain: Float[Array, " h"]
    shift: Float[Array, " h"]
    epsilon: float = eqx.field(static=True, default=1e-5)

    def deployed(self, weight, z):
        hidden = weight @ z
        centred = hidden - jnp.mean(hidden, axis=0)
        normal = centred * jax.lax.rsqrt(jnp.mean(jnp.square(centred), axis=0) + self.epsilon)
        return beside(self.gain, normal) * normal + beside(self.shift, normal)

    def layers(self, weight_in, weight_out, bias_out, z):
        return output_layer(weight_out, bias_out, self.deployed(weight_in, z))

    def observed(self, hidden):
        return self


class Bias(AffineNorm):
    """No normalisation: the pre-activations plus a bias, as in a plain linear layer."""

    shift: Float[Array, " h"]

    def fold(self, weight):
        return weight, self.shift

    def layers(self, weight_in, weight_out, bias_out, z):
        return output_layer(weight_out, bias_out, self.deployed(weight_in, z))

    def observed(self, hidden):
        return self


def output_layer(weight_out: Float[Array, "d h"], bias_out: Float[Array, " d"], hidden: Float[Array, "h b"]) -> Batch:
    """W₂ relu(h) + b₂ for each column."""
    active = jax.nn.relu(hidden)
    return weight_out @ active + beside(bias_out, active)


def product(weight: Float[Array, "h m"], z: Float[Array, " m *b"]) -> Float[Array, " h *b"]:
    """W z of each sample; of one or two inputs as a sum, for on a CPU a product of matrices costs more to begin."""
    if len(z) > FEW:
        return weight @ z
    return reduce(jnp.add, (beside(column, row[None]) * row for column, row in zip(weight.T, z, strict=True)))


def beside(values: Float[Array, " r"], rows: Float[Array, " _ *b"]) -> Float[Array, " r *b"]:
    """The values shaped so that they are the same for each column of rows, or for one sample."""
    return jnp.reshape(values, values.shape + (1,) * (rows.ndim - 1))
