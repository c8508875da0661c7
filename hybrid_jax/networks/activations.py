"""Activations of hidden units, by name, and a smooth one in the place of ReLU."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks

Activation = Callable[[Float[Array, " h *b"]], Float[Array, " h *b"]]

ACTIVATIONS: dict[str, Activation] = {
    "relu": jax.nn.relu,
    "softplus": jax.nn.softplus,
    "tanh": jnp.tanh,
    "silu": jax.nn.silu,
}


@dataclass(frozen=True)
class SmoothRelu:
    """½ (z + √(z² + 1/β²)): ReLU with all derivatives, at most 1/(2β) above it, at zero. ValueError unless β > 0."""

    beta: float

    def __post_init__(self):
        checks.positive("beta", self.beta)

    def __call__(self, z: Float[Array, " h *b"]) -> Float[Array, " h *b"]:
        return (z + jnp.sqrt(jnp.square(z) + self.beta**-2)) / 2


def function_of(activation: str | SmoothRelu) -> Activation:
    """The activation of a network, which holds its name: a function could not be sent to another process."""
    return ACTIVATIONS[activation] if isinstance(activation, str) else activation
