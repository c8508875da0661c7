"""f_d: a fully connected network with one hidden layer and batch normalisation (paper, App. A.1), and simpler rivals.

A linear map stands in for the whole network where the data are too few for one.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax import checks
from hybrid_jax.dynamics.base import (
    AbstractVectorField,
    RunningStats,
    fuse_for_inference,
    infer_batch,
    jvp_columns,
    linearize,
    train_batch,
    update_running_stats,
)
from hybrid_jax.networks.normalisation import (
    FEW,
    AffineNorm,
    BatchNorm,
    Bias,
    LayerNorm,
    Normalisation,
    beside,
    product,
)
from hybrid_jax.networks.scaling import AbstractScaling, ChannelScaling, InputScaling


class ResidualNetwork(AbstractVectorField):
    """ẋ = W₂ relu(norm(W₁ z)) + b₂ with z = [x, scaled u]; 17 → 64 → 13 with batch normalisation in the paper.

    W₁ has no bias: batch normalisation would remove it, and the others have a shift.
    """

    weight_in: Float[Array, "h m"]
    norm: Normalisation
    weight_out: Float[Array, "d h"]
    bias_out: Float[Array, " d"]
    scaling: AbstractScaling = eqx.field(default_factory=InputScaling)

    def __call__(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        """Deployment: normalised by the running statistics."""
        product = self.weight_out @ self.activations(x, u)
        return self.scaling.outputs(product + beside(self.bias_out, product))

    def activations(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " h *b"]:
        """The hidden units as deployed: what the output layer is linear in."""
        return jax.nn.relu(self.norm.deployed(self.weight_in, self.inputs(x, u)))

    def inputs(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " n+m *b"]:
        """z = [x, scaled u]."""
        return self.scaling.concatenate(x, u)


class LinearResidual(AbstractVectorField):
    """ẋ = W [x, u] + b: the simplest correction of another field."""

    weight: Float[Array, "d n"]
    bias: Float[Array, " d"]

    def __call__(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        product = self.weight @ jnp.concatenate([x, u])
        return product + beside(self.bias, product)


class LinearSkip(AbstractVectorField):
    """ẋ = A z + f_d(x, u), z = [x, scaled u]: a linear map past a network, which is left what is not linear.

    Linear drag is one, which units that bend can only approach; and where no data were, a line goes on as it was.
    """

    weight: Float[Array, "d m"]
    field: ResidualNetwork

    def __call__(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return self.weight @ self.field.inputs(x, u) + self.field(x, u)


class FusedNetwork(AbstractVectorField):
    """ẋ = W₂ relu(W₁ z + c) + A z + b, z = [x, scaled u]: a network as it is flown, and a linear map past it.

    The same map as `ResidualNetwork`, or `LinearSkip` around one, in another order of memory: a controller asks for few
    samples at a time, and products so thin are faster where the weights of an input lie side by side. One product
    serves W₁ and A, since it costs less than to begin another.

    Attributes:
        weight_in: [W₁; A]ᵀ.
        bias: [c; b].
        weight_out: W₂ᵀ.
    """

    weight_in: Float[Array, "m h+d"]
    bias: Float[Array, " h+d"]
    weight_out: Float[Array, "h d"]
    scaling: AbstractScaling

    def __call__(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        hidden, past = self.layer(self.scaling.concatenate(x, u))
        return (jax.nn.relu(hidden).T @ self.weight_out).T + past

    def layer(self, z: Float[Array, " m *b"]) -> tuple[Float[Array, " h *b"], Float[Array, " d *b"]]:
        """W₁ z + c and A z + b."""
        both = product(self.weight_in.T, z) if len(z) <= FEW else (z.T @ self.weight_in).T
        both = both + beside(self.bias, both)
        return both[: len(self.weight_out)], both[len(self.weight_out) :]


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
        scaling: by default read off the training windows by `hybrid_jax.fit`; see `scaling.with_scaling`.
        norm: what normalises the hidden units: "batch", "layer" or "none".
        outputs: how many numbers it returns, if not one for each of the state.

    Raises:
        ValueError: another norm, sizes that are no positive integers, or no random key.
    """
    if norm not in tuple(NORMS):
        raise ValueError(f"norm must be one of {', '.join(NORMS)}, got {checks.short_repr(norm)}")
    outputs = state_size if outputs is None else outputs
    sizes = {"state_size": state_size, "hidden": hidden, "outputs": outputs}
    for name, size in sizes.items():
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
    return BatchNorm(jnp.ones(hidden), jnp.zeros(hidden), RunningStats(jnp.zeros(hidden), jnp.ones(hidden)))


def _layer_norm(hidden: int, fan_in: int, key: PRNGKeyArray) -> LayerNorm:
    return LayerNorm(jnp.ones(hidden), jnp.zeros(hidden))


def _bias(hidden: int, fan_in: int, key: PRNGKeyArray) -> Bias:
    return Bias(_uniform(key, (hidden,), fan_in))


NORMS: dict[str, Callable[[int, int, PRNGKeyArray], Normalisation]] = {
    "batch": _batch_norm,
    "layer": _layer_norm,
    "none": _bias,
}


def _uniform(key: PRNGKeyArray, shape: tuple[int, ...], fan_in: int) -> Array:
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0) / fan_in**0.5


def zero_output(field: AbstractVectorField) -> AbstractVectorField:
    """The field with the output layer, and the linear path, of every network in it at zero: training begins at what
    physics says.

    Raises:
        ValueError: there is no network in it.
    """

    def is_network(node) -> bool:
        return isinstance(node, ResidualNetwork)

    if not any(map(is_network, jax.tree.leaves(field, is_leaf=is_network))):
        raise ValueError(f"field: there is no ResidualNetwork in {checks.short_repr(field)}")

    def silent(node):
        if isinstance(node, LinearSkip):
            return LinearSkip(jnp.zeros_like(node.weight), silent(node.field))
        if not is_network(node):
            return node
        zeros = jnp.zeros_like(node.weight_out), jnp.zeros_like(node.bias_out)
        return eqx.tree_at(lambda network: (network.weight_out, network.bias_out), node, zeros)

    return jax.tree.map(silent, field, is_leaf=lambda node: is_network(node) or isinstance(node, LinearSkip))


@train_batch.register
def _(field: ResidualNetwork, x, u) -> Array:
    """Training: where the norm is the batch's, each evaluation normalises by its own minibatch."""
    y = field.norm.layers(field.weight_in, field.weight_out, field.bias_out, field.inputs(x, u))
    return field.scaling.outputs(y)


@infer_batch.register(ResidualNetwork)
@infer_batch.register(LinearResidual)
@infer_batch.register(LinearSkip)
@infer_batch.register(FusedNetwork)
def _(field, x, u):
    return field(x, u)


@train_batch.register
def _(field: LinearSkip, x, u):
    return field.weight @ field.field.inputs(x, u) + train_batch(field.field, x, u)


@fuse_for_inference.register
def _(field: ResidualNetwork):
    none = jnp.zeros((len(field.weight_out), field.weight_in.shape[1]), field.weight_in.dtype)
    return _laid_out(field, field.norm, none) if isinstance(field.norm, AffineNorm) else field


@fuse_for_inference.register
def _(field: LinearSkip):
    return _laid_out(field.field, field.field.norm, field.weight) if isinstance(field.field.norm, AffineNorm) else field


def _laid_out(network: ResidualNetwork, norm: AffineNorm, past: Float[Array, "d m"]) -> FusedNetwork:
    weight, bias = norm.fold(network.weight_in)
    return FusedNetwork(
        weight_in=jnp.concatenate([weight, past]).T,
        bias=jnp.concatenate([bias, network.scaling.outputs(network.bias_out)]),
        weight_out=network.scaling.outputs(network.weight_out).T,
        scaling=network.scaling,
    )


@linearize.register
def _(field: FusedNetwork, x, u, dx, du):
    """By one product of the layers: hundreds of hidden units are gone before any direction is met."""
    z, directions = jvp_columns(field.scaling.concatenate, (x, u), (dx, du))
    hidden, past = field.layer(z)
    weight, linear = field.weight_in[:, : len(hidden)], field.weight_in[:, len(hidden) :]
    jacobian = jnp.where(hidden > 0, field.weight_out.T, 0) @ weight.T + linear.T
    return jax.nn.relu(hidden) @ field.weight_out + past, jacobian @ directions


@update_running_stats.register
def _(field: LinearSkip, x, u):
    return eqx.tree_at(lambda path: path.field, field, update_running_stats(field.field, x, u))


@update_running_stats.register
def _(field: ResidualNetwork, x, u):
    hidden = field.weight_in @ field.inputs(x, u)
    return eqx.tree_at(lambda network: network.norm, field, field.norm.observed(hidden))


@train_batch.register
def _(field: LinearResidual, x, u):
    return field(x, u)
