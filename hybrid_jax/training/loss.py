"""Minibatches, features first, and the regularisers L_reg that keep f_d from replacing f_p.

A regulariser is a function of (hybrid, minibatch, predicted states): the correlation of trajectories (paper, Eq. 7);
inner product, cosine and Pearson correlation of f_p and f_d (Takeishi and Kalousis 2023; Osaka et al. 2025); or ‖f_d‖²
(Yin et al. 2021, APHYNITY).
"""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import Hybrid, train_batch
from hybrid_jax.integrate import RK4, along, rollout_minibatch
from hybrid_jax.trajectories import Trajectories


class Minibatch(eqx.Module):
    """b windows of t intervals of dt [s], features first, and the solver that predicts them."""

    x0: Float[Array, "d b"]
    u: Float[Array, "t m b"]
    x: Float[Array, "t d b"]
    dt: float = eqx.field(static=True)
    solver: diffrax.AbstractSolver = eqx.field(static=True, default_factory=RK4)


Regulariser = Callable[[Hybrid, Minibatch, Float[Array, "t d b"]], Float[Array, ""]]


def minibatch(windows: Trajectories, solver: diffrax.AbstractSolver) -> Minibatch:
    """The windows with features first and samples last."""
    last = (jnp.moveaxis(a, 0, -1) for a in (windows.x0, windows.u, windows.x))
    return Minibatch(*last, dt=windows.dt, solver=solver)


def trajectory_correlation(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]) -> Float[Array, ""]:
    """1 − ⟨ŷ_p, ŷ⟩ / (‖ŷ_p‖ ‖ŷ‖), with ŷ_p the trajectory of f_p alone (paper, Eq. 7); the mean over trajectories."""
    physics = rollout_minibatch(field.physics, batch.x0, batch.u, batch.dt, batch.solver)
    a, b = (_unit(y.reshape(-1, y.shape[-1])) for y in (physics, predicted))
    # ½‖a − b‖² = 1 − ⟨a, b⟩ for unit vectors, without cancellation in float32.
    return jnp.mean(0.5 * jnp.sum(jnp.square(a - b), axis=0))


def inner_product(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]) -> Float[Array, ""]:
    """⟨f_p, f_d⟩² along the predicted trajectories, mean over samples: zero where the two are orthogonal."""
    physics, residual = _parts(field, batch, predicted)
    return jnp.mean(jnp.square(jnp.sum(physics * residual, axis=0)))


def cosine(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]) -> Float[Array, ""]:
    """cos² of the angle between f_p and f_d along the predicted trajectories, mean over samples."""
    physics, residual = _parts(field, batch, predicted)
    return jnp.mean(jnp.square(jnp.sum(_unit(physics) * _unit(residual), axis=0)))


def pearson(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]) -> Float[Array, ""]:
    """Squared Pearson correlation, over samples, of f_p and f_d, mean over the d derivatives."""
    a, b = (_unit((part - jnp.mean(part, axis=1, keepdims=True)).T) for part in _parts(field, batch, predicted))
    return jnp.mean(jnp.square(jnp.sum(a * b, axis=0)))


def residual_norm(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]) -> Float[Array, ""]:
    """‖f_d‖² along the predicted trajectories, mean over samples (Yin et al. 2021)."""
    return jnp.mean(jnp.sum(jnp.square(_parts(field, batch, predicted)[1]), axis=0))


REGULARISERS: dict[str, Regulariser] = {
    rule.__name__: rule for rule in (trajectory_correlation, inner_product, cosine, pearson, residual_norm)
}


def _parts(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]):
    x, u = along(batch.x0, predicted, batch.u)
    return train_batch(field.physics, x, u), train_batch(field.residual, x, u)


def _unit(columns: Float[Array, "d b"]) -> Float[Array, "d b"]:
    # The tiny constant keeps the gradient of a zero column finite.
    return columns / jnp.sqrt(jnp.sum(jnp.square(columns), axis=0, keepdims=True) + 1e-12)
