"""Measurement noise of motion capture and a gyroscope: white noise on the states of training flights."""

import zlib
from dataclasses import asdict, dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from experiments.runner.options import NotNegative
from hybrid_jax import rotation
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from hybrid_jax.trajectories import Trajectories


@dataclass(frozen=True)
class Noise:
    """Standard deviation of the white measurement noise on each entry of a group of the state."""

    position: NotNegative = 0.001
    """[m], motion capture."""
    quaternion: NotNegative = 0.002
    """Of each component, motion capture: about 0.2 degrees."""
    velocity: NotNegative = 0.02
    """[m/s], differentiated motion capture."""
    body_rates: NotNegative = 0.02
    """[rad/s], gyroscope."""


def measure(x: Float[Array, "*n 13"], noise: Noise, key: PRNGKeyArray) -> Float[Array, "*n 13"]:
    """The states with white noise; quaternions are normalised again."""
    sizes = np.zeros(13)
    for group, size in zip((POSITION, QUATERNION, VELOCITY, BODY_RATES), asdict(noise).values(), strict=True):
        sizes[group] = size
    noisy = x + jnp.asarray(sizes, x.dtype) * jax.random.normal(key, x.shape, x.dtype)
    return noisy.at[..., QUATERNION].set(rotation.normalise(noisy[..., QUATERNION]))


def measured(dataset: Dataset, level: float, seed: int) -> Dataset:
    """The dataset with `level` times the typical noise on all but its test splits."""
    if not level:
        return dataset
    noise = Noise(**{name: level * size for name, size in asdict(Noise()).items()})
    splits = dict(dataset.splits)
    for name, windows in dataset.splits.items():
        if not name.startswith("test"):
            start_key, key = jax.random.split(jax.random.fold_in(jax.random.key(seed), zlib.crc32(name.encode())))
            x0 = np.asarray(measure(jnp.asarray(windows.x0), noise, start_key))
            x = np.asarray(measure(jnp.asarray(windows.x), noise, key))
            splits[name] = Trajectories(x0, windows.u, x, windows.dt)
    return Dataset(splits, {**dataset.metadata, "noise": asdict(noise)})
