"""Systems that are no quadrotors, with windows of them: a driven pendulum, and one that is linear in θ_p."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import AbstractVectorField, Hybrid, Trajectories, portable, residual_network, rollout_batch
from hybrid_jax.state_space import Angle, Quantity, StateSpace

GRAVITY = 9.81
LENGTH, DAMPING = 0.5, 0.8  # of the true pendulum: [m], [1/s]


@portable
class Pendulum(AbstractVectorField):
    """x = (angle [rad], rate [rad/s]), u = (torque / inertia [1/s²],); the length is unknown, the damping known."""

    log_length: Float[Array, ""]
    damping: float = eqx.field(static=True, default=0.0)

    def __call__(self, x, u):
        angle, rate = x
        return jnp.stack([rate, u[0] - GRAVITY / jnp.exp(self.log_length) * jnp.sin(angle) - self.damping * rate])


class Damped(Pendulum):
    """The pendulum, with an unknown damping [1/s]."""

    damping: Float[Array, ""]


class Biased(eqx.Module):
    """A sensor of the angle, with an unknown bias [rad]."""

    bias: Float[Array, ""]

    def __call__(self, x, u):
        return x[0] + self.bias


@portable
class Whirling(Pendulum):
    """The pendulum, with an angle that is the same after a turn."""

    @property
    def state_space(self):
        return StateSpace((Angle("angle", labels=("angle",)), Quantity("rate", unit="rad/s", labels=("rate",))))


def whirling(length=LENGTH, damping=0.0):
    """As `pendulum`, on the circle."""
    return Whirling(jnp.log(jnp.asarray(length)), damping)


def pendulum(length=LENGTH, damping=0.0):
    """A pendulum of a length [m] and damping [1/s]."""
    return Pendulum(jnp.log(jnp.asarray(length)), damping)


@cache
def swings(count, steps=8, seed=0, dt=0.05, damping=DAMPING, length=LENGTH):
    """Windows of the true pendulum, or of another, from random starts under random torques."""
    rng = np.random.default_rng(seed)
    x0 = jnp.asarray(rng.uniform(-1, 1, (count, 2)) * [2.0, 4.0], np.float32)
    u = jnp.asarray(rng.normal(size=(count, steps, 1)) * 3, np.float32)
    return Trajectories(x0, u, jax.jit(rollout_batch)(pendulum(length, damping), x0, u, dt), dt)


@cache
def hybrid(length=0.7):
    """A pendulum beside a small network that says little."""
    network = residual_network(2, 1, jax.random.key(0), hidden=4, norm="none")
    return Hybrid(pendulum(length), jax.tree.map(lambda leaf: 0.1 * leaf, network))


def flown(truth, count=40, noise=0.003, seed=0):
    """Windows of a field with the states and inputs of a pendulum, and white noise."""
    start = swings(count, seed=seed)
    x = np.asarray(eqx.filter_jit(rollout_batch)(truth, start.x0, start.u, start.dt))
    return replace(start, x=x + noise * np.random.default_rng(seed).normal(size=x.shape).astype(np.float32))


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
