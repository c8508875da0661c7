"""Fixed scaling of what a network reads and returns, so that every channel counts alike whatever its unit.

`InputScaling` is chosen by hand. `ChannelScaling` is read off training windows: by `hybrid_jax.fit`, or by
`with_scaling` where a field is trained in another way.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.trajectories import Trajectories

Channels = tuple[float, ...]
SAMPLES = 10_000  # intervals that are looked at, at most
FLOOR = 0.01  # least scale of an input over the size of its mean, and of an output over the size of ẋ


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

    def concatenate(self, x, u):
        z = jnp.concatenate([x, u])
        if self.offset is None or self.scale is None:
            return z
        return (z - _column(self.offset, z)) / _column(self.scale, z)

    def outputs(self, y):
        return y if self.output is None else y * _column(self.output, y)


class _Silent(AbstractScaling):
    """Silences a network, so that its field is what is left without it. `seen` records what it reads and returns."""

    seen: list | None = eqx.field(static=True, default=None)

    def concatenate(self, x, u):
        return self.record(jnp.concatenate([x, u]))

    def outputs(self, y):
        return jnp.zeros_like(self.record(y))

    def record(self, values: Array) -> Array:
        if self.seen is not None:
            self.seen.append(values)
        return values


def with_scaling(field: AbstractVectorField, windows: Trajectories) -> AbstractVectorField:
    """The field with every `ChannelScaling` that is not set yet, as `residual_network` makes it, set from windows.

    Inputs are brought to mean 0 and standard deviation 1. If there is one output for each state, outputs are brought
    to the RMS of the derivative that the rest of the field lacks. A scaling that was given or set stays as it is.

    Args:
        windows: those that the field is to be trained on.
    """
    nodes, structure = jax.tree.flatten(field, is_leaf=_is_unset)
    unset = [place for place, node in enumerate(nodes) if _is_unset(node)]
    if not unset:
        return field
    x, u, after = _intervals(windows)

    silent = structure.unflatten([_Silent() if place in unset else node for place, node in enumerate(nodes)])
    predicted = rollout_batch(silent, x, u[:, None], windows.dt)[:, 0]
    lacking, rate = (np.asarray(after - start) / windows.dt for start in (predicted, x))
    output = _positive(_rms(lacking), FLOOR * _rms(rate))
    for place in unset:

        def read(x, u, place=place):
            seen = []
            structure.unflatten([*nodes[:place], _Silent(seen), *nodes[place + 1 :]])(x, u)
            return seen[0], seen[-1]

        z, y = jax.vmap(read)(x, u)
        mean = np.mean(z, axis=0)
        scale = _positive(np.std(z, axis=0), FLOOR * np.abs(mean))
        nodes[place] = ChannelScaling(tuple(mean.tolist()), scale, output if y.shape == x.shape else None)
    return structure.unflatten(nodes)


def _is_unset(node) -> bool:
    return isinstance(node, ChannelScaling) and node == ChannelScaling()


def _intervals(windows: Trajectories) -> tuple[Array, Array, Array]:
    """x, u and the next x of at most `SAMPLES` intervals."""
    before = jnp.concatenate([jnp.asarray(windows.x0)[:, None], jnp.asarray(windows.x)[:, :-1]], axis=1)
    every = -(-before.shape[0] * before.shape[1] // SAMPLES)
    u, after = jnp.asarray(windows.u), jnp.asarray(windows.x)
    x, u, after = (rows.reshape(-1, rows.shape[-1])[::every] for rows in (before, u, after))
    return x, u, after


def _rms(rows: Float[np.ndarray, "s d"]) -> Float[np.ndarray, " d"]:
    return np.sqrt(np.mean(np.square(rows), axis=0))


def _positive(scale: Float[np.ndarray, " d"], floor: Float[np.ndarray, " d"]) -> Channels:
    """The scale of each channel, no less than its floor; 1 where both are zero or the scale is not finite."""
    scale = np.maximum(scale, floor)
    return tuple(np.where(np.isfinite(scale) & (scale > 0), scale, 1.0).tolist())


def _column(values: Channels, rows: Float[Array, " d *b"]) -> Array:
    return jnp.asarray(values, rows.dtype).reshape((-1,) + (1,) * (rows.ndim - 1))
