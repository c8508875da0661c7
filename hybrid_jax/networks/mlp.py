"""Networks f_d with one hidden layer and batch normalisation (paper, App. A.1), and linear maps."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, jvp_columns, ravel_learned
from hybrid_jax.dynamics.batching import RunningStats, expand_trailing
from hybrid_jax.networks.normalisation import (
    UNROLLED_INPUTS,
    AbstractAffineNorm,
    AbstractNorm,
    AbstractScaling,
    Activation,
    BatchNorm,
    Bias,
    ChannelScaling,
    InputScaling,
    LayerNorm,
    affine,
    product,
)

NORMS = ("batch", "layer", "none")
ACTIVATIONS: dict[str, Activation] = {
    "relu": jax.nn.relu,
    "softplus": jax.nn.softplus,
    "tanh": jnp.tanh,
    "silu": jax.nn.silu,
}


@dataclass(frozen=True)
class SmoothRelu:
    """A smooth ReLU, ½ (z + √(z² + 1/β²)), which is at most 1/(2β) larger, at zero. ValueError unless β > 0."""

    beta: float

    def __post_init__(self):
        checks.positive("beta", self.beta)

    def __call__(self, z: Float[Array, " h *b"]) -> Float[Array, " h *b"]:
        return (z + jnp.sqrt(jnp.square(z) + self.beta**-2)) / 2


def function_of(activation: str | SmoothRelu) -> Activation:
    """Return an activation function. Networks store only its name, so that they can be sent to another process."""
    return ACTIVATIONS[activation] if isinstance(activation, str) else activation


class FusedNetwork(AbstractVectorField):
    """ẋ = W₂ σ(W₁ z + c) + A z + b, z = [x, scaled u]: a network with its normalisation folded in, and a linear map.

    It is equal to a `ResidualNetwork`, or `LinearSkip` around one, but faster for few samples at a time, for example in
    a controller: one product serves W₁ and A, and the weights of an input are contiguous.
    """

    accepts_batch: ClassVar[bool] = True

    weight_in: Float[Array, "m h+d"]  # [W₁; A]ᵀ
    bias: Float[Array, " h+d"]  # [c; b]
    weight_out: Float[Array, "h d"]  # W₂ᵀ
    scaling: AbstractScaling
    activation: str | SmoothRelu = eqx.field(static=True, default="relu")

    def __call__(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        hidden, linear = self.layer(self.scaling.concatenate(x, u))
        return (function_of(self.activation)(hidden).T @ self.weight_out).T + linear

    def layer(self, z: Float[Array, " m *b"]) -> tuple[Float[Array, " h *b"], Float[Array, " d *b"]]:
        both = product(self.weight_in.T, z) if len(z) <= UNROLLED_INPUTS else (z.T @ self.weight_in).T
        return jnp.split(both + expand_trailing(self.bias, both), [len(self.weight_out)])  # pyright: ignore[reportReturnType]

    def linearize(self, x, u, dx, du):
        """Differentiate by one product over the hidden units for any number of directions."""
        z, dz = jvp_columns(self.scaling.concatenate, (x, u), (dx, du))
        hidden, linear = self.layer(z)
        weight, skip = self.weight_in[:, : len(hidden)], self.weight_in[:, len(hidden) :]
        active, slope = jax.jvp(function_of(self.activation), (hidden,), (jnp.ones_like(hidden),))
        jacobian = (slope * self.weight_out.T) @ weight.T + skip.T
        return active @ self.weight_out + linear, jacobian @ dz


class ResidualNetwork(AbstractVectorField):
    """A network with one hidden layer, ẋ = W₂ σ(norm(W₁ z)) + b₂ with z = [x, scaled u] (paper: 17 → 64 → 13).

    W₁ has no bias, because the normalisation has one or would remove it.

    Attributes:
        weight_in: W₁ (h, m), for h hidden units and the m numbers of z.
        norm: normalisation of W₁ z before the activation.
        weight_out: W₂ (d, h).
        bias_out: b₂ (d,).
        scaling: scaling of inputs and outputs; z is [x, u] after scaling.
        activation: σ, a name as in `residual_network`, or a `SmoothRelu`.
    """

    accepts_batch: ClassVar[bool] = True

    weight_in: Float[Array, "h m"]
    norm: AbstractNorm
    weight_out: Float[Array, "d h"]
    bias_out: Float[Array, " d"]
    scaling: AbstractScaling = eqx.field(default_factory=InputScaling)
    activation: str | SmoothRelu = eqx.field(static=True, default="relu")

    state_size = property(lambda self: len(self.bias_out), doc="The size d of x, if the network is a whole field.")
    input_size = property(lambda self: self.weight_in.shape[1] - len(self.bias_out), doc="The size m of u, likewise.")

    def __call__(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return self.scaling.outputs(affine(self.weight_out, self.bias_out, self.activations(x, u)))

    def activations(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " h *b"]:
        """Return the hidden units in inference mode. The output layer is linear in them."""
        return function_of(self.activation)(self.norm.infer(self.weight_in, self.inputs(x, u)))

    def inputs(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " n+m *b"]:
        """Return z = [x, scaled u]."""
        if len(x) + len(u) != (size := self.weight_in.shape[1]):
            raise ValueError(f"x and u must have {size} entries in total, got {len(x)} and {len(u)}")
        return self.scaling.concatenate(x, u)

    def train_batch(self, x, u):
        layers = self.weight_in, self.weight_out, self.bias_out
        y = self.norm.train_layers(function_of(self.activation), *layers, self.inputs(x, u))
        return self.scaling.outputs(y)

    def update_running_stats(self, x, u):
        norm = self.norm.observed(self.weight_in, self.inputs(x, u))
        return eqx.tree_at(lambda network: network.norm, self, norm)

    def parameter_columns(self, x, u):
        theta, at = ravel_learned(self)
        return jax.jacrev(lambda theta: at(theta)(x, u))(theta)  # outputs are fewer than weights

    def fuse_for_inference(self):
        return self.fused_with(jnp.zeros((len(self.weight_out), self.weight_in.shape[1]), self.weight_in.dtype)) or self

    def fused_with(self, linear: Float[Array, "d m"]) -> FusedNetwork | None:
        """Return the sum of this network and a linear map of z as one module, or None if its norm is not affine.

        Args:
            linear: the map (d, m).
        """
        if not isinstance(self.norm, AbstractAffineNorm):
            return None
        weight_out, bias_out = self.scaling.outputs(self.weight_out), self.scaling.outputs(self.bias_out)
        weight_in, bias_in = self.norm.fold(self.weight_in)
        weight, bias = jnp.concatenate([weight_in, linear]).T, jnp.concatenate([bias_in, bias_out])
        return FusedNetwork(weight, bias, weight_out.T, self.scaling, self.activation)


class LinearResidual(AbstractVectorField):
    """A linear residual, ẋ = W [x, u] + b: the simplest correction of another field.

    Attributes:
        weight: W (d, n), for the n numbers of [x, u], in units of ẋ over theirs.
        bias: b (d,), in units of ẋ.
    """

    accepts_batch: ClassVar[bool] = True

    weight: Float[Array, "d n"]
    bias: Float[Array, " d"]

    def __call__(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return affine(self.weight, self.bias, jnp.concatenate([x, u]))


class LinearSkip(AbstractVectorField):
    """ẋ = A z + f_d(x, u), z = [x, scaled u]: a linear skip connection around a network.

    For example, it represents linear drag exactly and extrapolates it beyond the data, unlike hidden units.
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

    def fuse_for_inference(self):
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
    activation: str = "relu",
) -> ResidualNetwork:
    """Make a network with weights uniform in ±1/√fan_in, as in the paper.

    Args:
        state_size: d, the size of x.
        input_size: m, the size of u; may be 0.
        hidden: number of hidden units. With few data you should choose few, for example 16.
        scaling: scaling of inputs and outputs; by default `hybrid_jax.fit` sets it from the training windows.
        norm: normalisation of the hidden units: "batch", "layer" or "none".
        outputs: size of the output, by default `state_size`.
        activation: "relu" (paper), "softplus", "tanh" or "silu". For solvers with derivatives, it should be smooth.

    Raises:
        ValueError: if the norm or activation is unknown, a size is not a positive integer, or key is not a random key.
    """
    for name, chosen, known in (("norm", norm, NORMS), ("activation", activation, tuple(ACTIVATIONS))):
        if chosen not in known:  # it may not be hashable
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {checks.short_repr(chosen)}")
    outputs = state_size if outputs is None else outputs
    for name, size in {"state_size": state_size, "hidden": hidden, "outputs": outputs}.items():
        checks.count(name, size)
    checks.count("input_size", input_size, least=0)
    checks.key("key", key)
    weights = _weights(key, state_size + input_size, hidden, outputs, norm)
    return ResidualNetwork(*weights, scaling=ChannelScaling() if scaling is None else scaling, activation=activation)


@eqx.filter_jit
def _weights(key: PRNGKeyArray, fan_in: int, hidden: int, outputs: int, norm: str):
    def uniform(key: PRNGKeyArray, shape: tuple[int, ...], fan_in: int) -> Array:
        return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0) / fan_in**0.5

    key_in, key_out, key_bias = jax.random.split(key, 3)
    ones, zeros = jnp.ones(hidden), jnp.zeros(hidden)
    norms: dict[str, Callable[[], AbstractNorm]] = {
        "batch": lambda: BatchNorm(gain=ones, shift=zeros, running=RunningStats(zeros, ones)),
        "layer": lambda: LayerNorm(ones, zeros),
        "none": lambda: Bias(uniform(jax.random.fold_in(key, 3), (hidden,), fan_in)),
    }
    weight_out, bias_out = uniform(key_out, (outputs, hidden), hidden), uniform(key_bias, (outputs,), hidden)
    return uniform(key_in, (hidden, fan_in), fan_in), norms[norm](), weight_out, bias_out


def zero_output(field: AbstractVectorField) -> AbstractVectorField:
    """Set all output layers and linear skip connections to zero; ValueError if the field contains no network.

    Args:
        field: a network, or a field that contains one.
    """

    def has_outputs(node) -> bool:
        return isinstance(node, ResidualNetwork | LinearSkip)

    if not any(map(has_outputs, jax.tree.leaves(field, is_leaf=has_outputs))):
        raise ValueError(f"field: there is no ResidualNetwork in {checks.short_repr(field)}")

    def zeroed(node):
        if isinstance(node, LinearSkip):
            return LinearSkip(jnp.zeros_like(node.weight), zeroed(node.field))
        if not has_outputs(node):
            return node
        return eqx.tree_at(lambda network: (network.weight_out, network.bias_out), node, replace_fn=jnp.zeros_like)

    return jax.tree.map(zeroed, field, is_leaf=has_outputs)


def smoothed(field: AbstractVectorField, beta: float) -> AbstractVectorField:
    """Replace each ReLU of a field by `SmoothRelu`, but not other activations. ValueError unless β > 0.

    You should use this for solvers with second derivatives, which are zero for ReLU except at its kink. It changes the
    networks of this library, and modules with `jax.nn.relu` as a field, for example Equinox' MLP.

    Args:
        field: the field whose networks are changed.
        beta: β, sharpness of `SmoothRelu`; larger values are closer to ReLU.
    """
    smooth = SmoothRelu(beta)

    def has_relu(node) -> bool:
        return isinstance(node, ResidualNetwork | FusedNetwork) and node.activation == "relu"

    def changed(node):
        return replace(node, activation=smooth) if has_relu(node) else smooth if node is jax.nn.relu else node

    return jax.tree.map(changed, field, is_leaf=has_relu)
