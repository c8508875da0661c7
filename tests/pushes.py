"""A system that is linear in its parameters, so that least squares has a closed form, with windows of it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.trajectories import Trajectories


class Push(AbstractVectorField):
    """ẋ = (a u₀ + b u₁, b u₀): linear in its parameters, so least squares has a closed form."""

    gains: Float[Array, " 2"]

    def __call__(self, x, u):
        a, b = self.gains
        return jnp.stack([a * u[0] + b * u[1], b * u[0]])


def pushes(count, noise, unit=1.0, steps=6, dt=0.1):
    """Windows of Push(3, −2) with white noise on the states, gains in units of `unit`; and ∂x/∂gains (n, t·d, 2)."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(count, steps, 2)) / unit
    reached = dt * np.cumsum(u, axis=1)
    zero = np.zeros((count, steps))
    design = np.stack([np.stack([reached[..., 0], zero], -1), reached[..., ::-1]], -1)
    x = design @ [3.0 * unit, -2.0 * unit] + noise * rng.normal(size=(count, steps, 2))
    windows = Trajectories(np.zeros((count, 2), np.float32), u.astype(np.float32), x.astype(np.float32), dt)
    return windows, design.reshape(count, -1, 2)
