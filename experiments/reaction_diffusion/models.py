"""Shared by the studies: weights as a vector, forecasts and their error, and windows from trajectories."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import hybrid_jax as hj
from hybrid_jax.dynamics.base import ravel_learned


def weights(model: hj.AbstractVectorField) -> np.ndarray:
    return np.asarray(ravel_learned(model)[0])


def with_weights(model: Any, vector: np.ndarray) -> Any:
    return ravel_learned(model)[1](jnp.asarray(vector))


@eqx.filter_jit
def predicted(model, data: hj.Trajectories, solver) -> jax.Array:
    one = lambda pair: hj.rollout(model, pair[0], pair[1], data.dt, solver)  # noqa: E731
    return jax.lax.map(one, (jnp.asarray(data.x0), jnp.asarray(data.u)), batch_size=4)


def error(model, data: hj.Trajectories, solver) -> float:
    """Mean squared error over all states after the first; inf if a forecast is not finite."""
    value = float(np.mean(np.square(np.asarray(predicted(model, data, solver), float) - data.x)))
    return value if np.isfinite(value) else float("inf")


def pieces(data: hj.Trajectories, every: int, steps: int = 1, first: int = 0) -> hj.Trajectories:
    """Return windows of `steps` intervals from each trajectory in turn, every so many intervals from the `first`."""
    states = np.concatenate([data.x0[:, None], data.x], axis=1)
    starts = range(first, data.horizon - steps + 1, every)

    def each(part, length):
        found = np.stack([part[:, i : i + length] for i in starts], axis=1)
        return found.reshape(len(part) * len(starts), length, part.shape[-1])

    return hj.Trajectories(each(states, 1)[:, 0], each(data.u, steps), each(states[:, 1:], steps), data.dt)
