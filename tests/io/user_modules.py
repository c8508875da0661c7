"""Models as a user writes them: none is known to the library."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pendulum import pendulum
from systems import Dense

import hybrid_jax as hj
from hybrid_jax.dynamics.baselines import Kinematics


class Convolution(hj.AbstractVectorField):
    layers: list

    def __init__(self, key):
        first, second = jax.random.split(key)
        self.layers = [eqx.nn.Conv1d(1, 4, 3, padding=1, key=first), jnp.tanh, eqx.nn.Conv1d(4, 1, 3, key=second)]

    def __call__(self, x, u):
        first, activation, second = self.layers
        return second(jnp.pad(activation(first(x[None])), ((0, 0), (1, 1))))[0] + u[0]


class Scaled(hj.AbstractVectorField):
    inner: hj.AbstractVectorField
    scale: tuple = eqx.field(static=True)

    def __call__(self, x, u):
        return jnp.asarray(self.scale) * self.inner(x, u)


@hj.portable
def leaky(z):
    return jnp.where(z > 0, z, 0.3 * z)


@hj.portable
@dataclass(frozen=True)
class Options:
    gain: float = 0.5
    steps: tuple = (1, 2)


class Layer(eqx.Module):
    linear: eqx.nn.Linear
    norm: eqx.nn.LayerNorm | None
    activation: object

    def __init__(self, size, norm, activation, key):
        self.linear = eqx.nn.Linear(size, size, key=key)
        self.norm = eqx.nn.LayerNorm(size) if norm else None
        self.activation = activation

    def __call__(self, z):
        return self.activation((self.norm or (lambda z: z))(self.linear(z)))


class Nested(hj.AbstractVectorField):
    blocks: dict
    limits: tuple
    noise: jax.Array
    dtype: object = eqx.field(static=True)
    options: Options = eqx.field(static=True)

    def __init__(self, key):
        first, second, self.noise = jax.random.split(key, 3)
        layers = [Layer(3, True, leaky, first), Layer(3, False, jax.nn.silu, second)]
        self.blocks = {"layers": layers, "shift": {0: jnp.full(2, 0.1, jnp.bfloat16)}}
        self.limits, self.dtype, self.options = (-float("inf"), 5.0), jnp.float32, Options(0.7)

    def __call__(self, x, u):
        z = jnp.concatenate([x, u])
        for layer in self.blocks["layers"]:
            z = layer(z)
        z = z[:2] + self.blocks["shift"][0].astype(self.dtype) + 0.01 * jax.random.normal(self.noise, (2,))
        return self.options.gain * jnp.clip(z, *self.limits)


KEY = np.zeros(2, np.uint32)  # jax.random.key(0)
MAKERS = {
    "perceptron": lambda: Dense(eqx.nn.MLP(3, 2, 8, 2, activation=jax.nn.gelu, key=KEY)),
    "convolution": lambda: Convolution(KEY),
    "wrapper": lambda: Scaled(hj.residual_network(2, 1, KEY, hidden=4), (1.0, 2.0)),
    "pendulum": lambda: hj.Hybrid(pendulum(0.7), hj.residual_network(2, 1, KEY, hidden=4)),
    "nested": lambda: Nested(jax.random.key(0)),  # which keeps its key
    "no physics": lambda: hj.Hybrid(Kinematics(), hj.residual_network(13, 4, KEY, hidden=4)),
}


@cache
def made(name):
    """A model with random weights; the same at every call."""
    return MAKERS[name]()


def prediction(name, model):
    size, inputs = {"convolution": (16, 1), "no physics": (13, 4)}.get(name, (2, 1))
    rng = np.random.default_rng(0)
    x0 = rng.normal(size=(3, size)).astype(np.float32)
    if x0.shape[-1] == 13:
        x0[:, 3:7] /= np.linalg.norm(x0[:, 3:7], axis=1, keepdims=True)
    return np.asarray(model.predict(x0, rng.normal(size=(3, 4, inputs)).astype(np.float32), 0.01))


def predict_all(folder):
    """What a fresh process does with saved models; it makes none itself."""
    found = {path.stem: prediction(path.stem, hj.load(path)) for path in Path(folder).glob("*.npz")}
    np.savez(Path(folder) / "predictions.npy", **found)
