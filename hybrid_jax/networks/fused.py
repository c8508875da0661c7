"""A network in inference mode in a layout for few samples at a time, as a controller evaluates it."""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, jvp_columns
from hybrid_jax.dynamics.batching import expand_trailing
from hybrid_jax.networks.normalisation import UNROLLED_INPUTS, product
from hybrid_jax.networks.scaling import AbstractScaling


class FusedNetwork(AbstractVectorField):
    """ẋ = W₂ relu(W₁ z + c) + A z + b, z = [x, scaled u]: a network with its normalisation folded in, and a linear map.

    The same map as `ResidualNetwork`, or `LinearSkip` around one. The weights are transposed, since products with few
    columns are faster where the weights of an input are contiguous, and one product serves W₁ and A.

    Attributes:
        weight_in: [W₁; A]ᵀ.
        bias: [c; b].
        weight_out: W₂ᵀ.
    """

    accepts_batch: ClassVar[bool] = True

    weight_in: Float[Array, "m h+d"]
    bias: Float[Array, " h+d"]
    weight_out: Float[Array, "h d"]
    scaling: AbstractScaling

    def __call__(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        hidden, linear = self.layer(self.scaling.concatenate(x, u))
        return (jax.nn.relu(hidden).T @ self.weight_out).T + linear

    def layer(self, z: Float[Array, " m *b"]) -> tuple[Float[Array, " h *b"], Float[Array, " d *b"]]:
        """W₁ z + c and A z + b."""
        both = product(self.weight_in.T, z) if len(z) <= UNROLLED_INPUTS else (z.T @ self.weight_in).T
        both = both + expand_trailing(self.bias, both)
        return both[: len(self.weight_out)], both[len(self.weight_out) :]

    def linearize(self, x, u, dx, du):
        """The Jacobian with respect to z is one product over the hidden units, whatever the number of directions."""
        z, dz = jvp_columns(self.scaling.concatenate, (x, u), (dx, du))
        hidden, linear = self.layer(z)
        weight, skip = self.weight_in[:, : len(hidden)], self.weight_in[:, len(hidden) :]
        jacobian = jnp.where(hidden > 0, self.weight_out.T, 0) @ weight.T + skip.T
        return jax.nn.relu(hidden) @ self.weight_out + linear, jacobian @ dz
