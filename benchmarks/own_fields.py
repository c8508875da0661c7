"""Fields that a user writes for one sample, with networks of `equinox.nn`, and windows to train them on."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks import plain
from benchmarks.subjects import DT
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.trajectories import Trajectories

OwnField = Literal["mlp 2", "mlp 13", "mlp 64", "conv 64"]  # network and number of states
INPUTS, HIDDEN, CHANNELS = 2, 64, 8


class Decay(AbstractVectorField):
    """ẋ = −k x + W₂ ∘ tanh ∘ W₁ of [x, u], or of x where W₁ and W₂ are convolutions along the states."""

    rate: Float[Array, ""]
    first: eqx.nn.Linear | eqx.nn.Conv1d
    second: eqx.nn.Linear | eqx.nn.Conv1d

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        inputs = jnp.concatenate([x, u]) if isinstance(self.first, eqx.nn.Linear) else x[None]
        return -self.rate * x + self.second(jnp.tanh(self.first(inputs))).reshape(x.shape)


def own_field(name: OwnField) -> Decay:
    """A fresh field by its name."""
    states, (one, other) = size_of(name), jax.random.split(jax.random.key(0))
    if name.startswith("mlp"):
        layers = eqx.nn.Linear(states + INPUTS, HIDDEN, key=one), eqx.nn.Linear(HIDDEN, states, key=other)
    else:
        layers = tuple(
            eqx.nn.Conv1d(*channels, 5, padding="SAME", key=key)
            for channels, key in (((1, CHANNELS), one), ((CHANNELS, 1), other))
        )
    return Decay(jnp.asarray(0.5), *layers)


def size_of(name: OwnField) -> int:
    """The number of states."""
    return int(name.split()[1])


def own_windows(name: OwnField, count: int, steps: int) -> Trajectories:
    """Windows of a linear decay from random starts, in float32."""
    rng, states = np.random.default_rng(0), size_of(name)
    x0 = rng.normal(size=(count, states)).astype(np.float32)
    u = rng.normal(size=(count, steps, INPUTS)).astype(np.float32)
    return Trajectories(x0, u, np.asarray(jax.vmap(lambda x0, u: plain.rk4(lambda x, u: -x, x0, u))(x0, u)), DT)
