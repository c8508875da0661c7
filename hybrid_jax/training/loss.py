"""Minibatches, features first, and the regularisers L_reg that keep f_d from replacing f_p.

Inner product, cosine and Pearson correlation of f_p and f_d: Takeishi and Kalousis 2023; Osaka et al. 2025.
"""

from collections.abc import Callable
from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import kernels
from hybrid_jax.dynamics.base import AbstractVectorField, as_field
from hybrid_jax.dynamics.batching import batch_norms, over_samples, training_mode
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.integrate import RK4, Solver, integrate

# Traced once for all stages of a step, not once for each; the compiler inlines it again.
_train = eqx.filter_jit(lambda field, x, u: as_field(field).train_batch(x, u))
_evaluate = eqx.filter_jit(lambda field, x, u: field(x, u))


class Minibatch(eqx.Module):
    """b windows of t intervals of dt [s], features first, and the solver that predicts them."""

    x0: Float[Array, "d b"]
    u: Float[Array, "t m b"]
    x: Float[Array, "t d b"]
    dt: float = eqx.field(static=True)
    solver: Solver = eqx.field(static=True, default_factory=RK4)


Regulariser = Callable[[Hybrid, Minibatch, Float[Array, "t d b"]], Float[Array, ""]]


def rollout_minibatch(
    field: AbstractVectorField, x0: Float[Array, "d b"], u: Float[Array, "t m b"], dt: float, solver: Solver
) -> Float[Array, "t d b"]:
    """Predict a minibatch in training mode, features first, so that batch normalisation uses all windows."""
    plain = partial(_by_jax, dt=dt, solver=solver)
    states = kernels.trained(field, x0, u, dt, solver, plain)
    return plain(field, x0, u) if states is None else states


def _by_jax(field, x0: Float[Array, "d b"], u: Float[Array, "t m b"], dt: float, solver: Solver):
    implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
    # With batch normalisation, an implicit solver solves one system of equations for all windows.
    if batch_norms(field) if implicit else as_field(field).features_first:
        return integrate(lambda x, held: _train(field, x, held), x0, u, dt, solver)
    alone = training_mode(field)  # samples first: transposing in each evaluation costs up to half the step

    def one_window(x0, u):
        return integrate(lambda x, held: _evaluate(alone, x, held), x0, u, dt, solver)

    return over_samples(one_window)(x0, u)


def along(x0: Float[Array, "d b"], x: Float[Array, "t d b"], u: Float[Array, "t m b"]):
    """Return the states and inputs at the start of every interval as columns: x (d, t·b), u (m, t·b)."""
    starts = jnp.concatenate([x0[None], x[:-1]])
    # Without the barrier, XLA looks up every number by its own index.
    moved = jax.lax.optimization_barrier([jnp.moveaxis(a, 0, 1) for a in (starts, u)])
    return (jax.lax.collapse(a, 1) for a in moved)


def trajectory_correlation(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]) -> Float[Array, ""]:
    """Return the mean of 1 − ⟨ŷ_p, ŷ⟩ / (‖ŷ_p‖ ‖ŷ‖), with ŷ_p the trajectory without f_d (paper, Eq. 7)."""
    physics = rollout_minibatch(field.physics, batch.x0, batch.u, batch.dt, batch.solver)
    rows = correlation_rows(*(y.reshape(-1, y.shape[-1]) for y in (physics, predicted)))
    return jnp.mean(jnp.sum(jnp.square(rows), axis=0))


def correlation_rows(physics: Float[Array, "r b"], predicted: Float[Array, "r b"]) -> Float[Array, "r b"]:
    """Return (ŷ_p/‖ŷ_p‖ − ŷ/‖ŷ‖)/√2, whose square is 1 − ⟨ŷ_p, ŷ⟩/(‖ŷ_p‖ ‖ŷ‖), without cancellation in float32."""
    return (_unit(physics) - _unit(predicted)) / 2**0.5


def inner_product(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]) -> Float[Array, ""]:
    """Return the mean of ⟨f_p, f_d⟩² over samples of the predicted trajectories: zero if they are orthogonal."""
    physics, residual = _parts(field, batch, predicted)
    return jnp.mean(jnp.square(jnp.sum(physics * residual, axis=0)))


def cosine(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]) -> Float[Array, ""]:
    """Return the mean cos² of the angle between f_p and f_d over samples of the predicted trajectories."""
    physics, residual = _parts(field, batch, predicted)
    return jnp.mean(jnp.square(jnp.sum(_unit(physics) * _unit(residual), axis=0)))


def pearson(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]) -> Float[Array, ""]:
    """Return the squared Pearson correlation of f_p and f_d over samples, averaged over the d derivatives."""
    a, b = (_unit((part - jnp.mean(part, axis=1, keepdims=True)).T) for part in _parts(field, batch, predicted))
    return jnp.mean(jnp.square(jnp.sum(a * b, axis=0)))


def residual_norm(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]) -> Float[Array, ""]:
    """Return the mean of ‖f_d‖² over samples of the predicted trajectories (APHYNITY; Yin et al. 2021)."""
    return jnp.mean(jnp.sum(jnp.square(_parts(field, batch, predicted)[1]), axis=0))


REGULARISERS: dict[str, Regulariser] = {
    rule.__name__: rule for rule in (trajectory_correlation, inner_product, cosine, pearson, residual_norm)
}


def _parts(field: Hybrid, batch: Minibatch, predicted: Float[Array, "t d b"]) -> list[Float[Array, "d s"]]:
    x, u = along(batch.x0, predicted, batch.u)
    return [as_field(part).train_batch(field.read(x), u) for part in (field.physics, field.residual)]


def _unit(columns: Float[Array, "d b"]) -> Float[Array, "d b"]:
    # The tiny constant keeps the gradient of a zero column finite.
    return columns / jnp.sqrt(jnp.sum(jnp.square(columns), axis=0, keepdims=True) + 1e-12)
