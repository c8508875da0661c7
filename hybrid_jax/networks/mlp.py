"""f_d: a fully connected network with one hidden layer and batch normalisation (paper, App. A.1).

Also a linear map: beside the network (`LinearSkip`), or instead of it where there are too few data for one.
"""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.batching import RunningStats
from hybrid_jax.networks.fused import FusedNetwork
from hybrid_jax.networks.normalisation import AbstractAffineNorm, AbstractNorm, BatchNorm, Bias, LayerNorm, affine
from hybrid_jax.networks.scaling import AbstractScaling, ChannelScaling, InputScaling


class ResidualNetwork(AbstractVectorField):
    """ẋ = W₂ relu(norm(W₁ z)) + b₂ with z = [x, scaled u]; 17 → 64 → 13 with batch normalisation in the paper.

    W₁ has no bias: batch normalisation would remove it, and the others have a shift.
    """

    accepts_batch: ClassVar[bool] = True

    weight_in: Float[Array, "h m"]
    norm: AbstractNorm
    weight_out: Float[Array, "d h"]
    bias_out: Float[Array, " d"]
    scaling: AbstractScaling = eqx.field(default_factory=InputScaling)

    @property
    def state_size(self) -> int:
        """d, where the network is a field by itself."""
        return len(self.bias_out)

    @property
    def input_size(self) -> int:
        """m, where the network is a field by itself."""
        return self.weight_in.shape[1] - len(self.bias_out)

    def __call__(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return self.scaling.outputs(affine(self.weight_out, self.bias_out, self.activations(x, u)))

    def activations(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " h *b"]:
        """The hidden units in inference mode, in which the output layer is linear."""
        return jax.nn.relu(self.norm.infer(self.weight_in, self.inputs(x, u)))

    def inputs(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " n+m *b"]:
        """z = [x, scaled u]."""
        return self.scaling.concatenate(x, u)

    def train_batch(self, x, u):
        y = self.norm.train_layers(self.weight_in, self.weight_out, self.bias_out, self.inputs(x, u))
        return self.scaling.outputs(y)

    def update_running_stats(self, x, u):
        norm = self.norm.observed(self.weight_in @ self.inputs(x, u))
        return eqx.tree_at(lambda network: network.norm, self, norm)

    def fuse_for_inference(self) -> "ResidualNetwork | FusedNetwork":
        return self.fused_with(jnp.zeros((len(self.weight_out), self.weight_in.shape[1]), self.weight_in.dtype)) or self

    def fused_with(self, linear: Float[Array, "d m"]) -> FusedNetwork | None:
        """This and a linear map of z in one, or None if the normalisation is no affine map."""
        if not isinstance(self.norm, AbstractAffineNorm):
            return None
        weight_out, bias_out = self.scaling.outputs(self.weight_out), self.scaling.outputs(self.bias_out)
        weight_in, bias_in = self.norm.fold(self.weight_in)
        weight, bias = jnp.concatenate([weight_in, linear]).T, jnp.concatenate([bias_in, bias_out])
        return FusedNetwork(weight, bias, weight_out.T, self.scaling)


class LinearResidual(AbstractVectorField):
    """ẋ = W [x, u] + b: the simplest correction of another field."""

    accepts_batch: ClassVar[bool] = True

    weight: Float[Array, "d n"]
    bias: Float[Array, " d"]

    def __call__(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return affine(self.weight, self.bias, jnp.concatenate([x, u]))


class LinearSkip(AbstractVectorField):
    """ẋ = A z + f_d(x, u), z = [x, scaled u]: a linear skip connection around a network.

    Linear drag is such a map, which ReLU units only approximate, and which extrapolates beyond the data.
    """

    accepts_batch: ClassVar[bool] = True

    weight: Float[Array, "d m"]
    field: ResidualNetwork

    def __call__(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return self.weight @ self.field.inputs(x, u) + self.field(x, u)

    def train_batch(self, x, u):
        return self.weight @ self.field.inputs(x, u) + self.field.train_batch(x, u)

    def update_running_stats(self, x, u):
        return LinearSkip(self.weight, self.field.update_running_stats(x, u))

    def fuse_for_inference(self) -> "LinearSkip | FusedNetwork":
        return self.field.fused_with(self.weight) or self


def residual_network(
    state_size: int,
    input_size: int,
    key: PRNGKeyArray,
    *,
    hidden: int = 64,
    scaling: AbstractScaling | None = None,
    norm: str = "batch",
    outputs: int | None = None,
) -> ResidualNetwork:
    """A network with weights uniform in ±1/√fan_in, as the paper's stack initialises a linear layer.

    Args:
        scaling: by default read off the training windows by `hybrid_jax.fit`; see `standardise.with_scaling`.
        norm: normalisation of the hidden units: "batch", "layer" or "none".
        outputs: size of what it returns, by default `state_size`.

    Raises:
        ValueError: another norm, sizes that are no positive integers, or no random key.
    """
    if norm not in tuple(NORMS):
        raise ValueError(f"norm must be one of {', '.join(NORMS)}, got {checks.short_repr(norm)}")
    outputs = state_size if outputs is None else outputs
    for name, size in {"state_size": state_size, "hidden": hidden, "outputs": outputs}.items():
        checks.count(name, size)
    checks.count("input_size", input_size, least=0)
    checks.key("key", key)
    key_in, key_out, key_bias = jax.random.split(key, 3)
    fan_in = state_size + input_size
    return ResidualNetwork(
        weight_in=_uniform(key_in, (hidden, fan_in), fan_in),
        norm=NORMS[norm](hidden, fan_in, jax.random.fold_in(key, 3)),
        weight_out=_uniform(key_out, (outputs, hidden), hidden),
        bias_out=_uniform(key_bias, (outputs,), hidden),
        scaling=ChannelScaling() if scaling is None else scaling,
    )


def _batch_norm(hidden: int, fan_in: int, key: PRNGKeyArray) -> BatchNorm:
    running = RunningStats(jnp.zeros(hidden), jnp.ones(hidden))
    return BatchNorm(gain=jnp.ones(hidden), shift=jnp.zeros(hidden), running=running)


NORMS: dict[str, Callable[[int, int, PRNGKeyArray], AbstractNorm]] = {
    "batch": _batch_norm,
    "layer": lambda hidden, fan_in, key: LayerNorm(jnp.ones(hidden), jnp.zeros(hidden)),
    "none": lambda hidden, fan_in, key: Bias(_uniform(key, (hidden,), fan_in)),
}


def _uniform(key: PRNGKeyArray, shape: tuple[int, ...], fan_in: int) -> Array:
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0) / fan_in**0.5


def zero_output(field: AbstractVectorField) -> AbstractVectorField:
    """The field with every output layer and linear skip connection at zero, so that training starts at the physics.

    Raises:
        ValueError: the field contains no network.
    """

    def is_network(node) -> bool:
        return isinstance(node, ResidualNetwork)

    if not any(map(is_network, jax.tree.leaves(field, is_leaf=is_network))):
        raise ValueError(f"field: there is no ResidualNetwork in {checks.short_repr(field)}")

    def outputs(network):
        return network.weight_out, network.bias_out

    def zeroed(node):
        if isinstance(node, LinearSkip):
            return LinearSkip(jnp.zeros_like(node.weight), zeroed(node.field))
        return eqx.tree_at(outputs, node, replace_fn=jnp.zeros_like) if is_network(node) else node

    return jax.tree.map(zeroed, field, is_leaf=lambda node: is_network(node) or isinstance(node, LinearSkip))
