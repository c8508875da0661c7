"""Fixed scaling of what a network reads and returns, so that every channel counts alike whatever its unit.

`InputScaling` is chosen by hand. `ChannelScaling` is read off training windows: by `hybrid_jax.fit`, or by
`standardise.with_scaling` where a field is trained in another way.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.batching import expand_trailing

Channels = tuple[float, ...]


class AbstractScaling(eqx.Module):
    """What a network does to its input [x, u] and to its output. Training leaves it alone."""

    @abstractmethod
    def concatenate(self, x: Float[Array, " n *b"], u: Float[Array, " m *b"]) -> Float[Array, " n+m *b"]:
        """z, the scaled [x, u]."""

    def outputs(self, y: Float[Array, " d *b"]) -> Float[Array, " d *b"]:
        """The network's output y in units of ẋ."""
        return y


class InputScaling(AbstractScaling):
    """u ↦ (u − offset) / scale, with the same two numbers for all inputs; x and the output as they are.

    Raises:
        ValueError: an offset that is not finite, or a scale that is not positive.
    """

    offset: float = eqx.field(static=True, default=0.0)
    scale: float = eqx.field(static=True, default=1.0)

    def __check_init__(self):
        checks.number("offset", self.offset)
        checks.positive("scale", self.scale)

    def __call__(self, u: Float[Array, " m *b"]) -> Float[Array, " m *b"]:
        return (u - self.offset) / self.scale

    def concatenate(self, x, u):
        return jnp.concatenate([x, self(u)])


class ChannelScaling(AbstractScaling):
    """z = ([x, u] − offset) / scale and ẋ = output ⊙ y, channel by channel; what is None is left as it is.

    Attributes:
        offset, scale: one number for each entry of [x, u].
        output: one number for each entry of the network's output.
    """

    offset: Channels | None = eqx.field(static=True, default=None)
    scale: Channels | None = eqx.field(static=True, default=None)
    output: Channels | None = eqx.field(static=True, default=None)

    @property
    def is_set(self) -> bool:
        return (self.offset, self.scale, self.output) != (None, None, None)

    def concatenate(self, x, u):
        z = jnp.concatenate([x, u])
        if self.offset is None or self.scale is None:
            return z
        offset, scale = (expand_trailing(jnp.asarray(values, z.dtype), z) for values in (self.offset, self.scale))
        return (z - offset) / scale

    def outputs(self, y):
        return y if self.output is None else y * expand_trailing(jnp.asarray(self.output, y.dtype), y)
