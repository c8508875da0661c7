"""Trajectories of many windows at once, by the kernels of `hybrid_jax.kernels` where available, else by JAX."""

import diffrax
import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import kernels
from hybrid_jax.dynamics.base import AbstractVectorField, as_field
from hybrid_jax.dynamics.batching import batch_norms, over_samples, training_mode
from hybrid_jax.integrate import LONG, RK4, Solver, integrate, rollout_batch

# Traced once for all stages of a step, not once for each; the compiler inlines it again.
_train = eqx.filter_jit(lambda field, x, u: as_field(field).train_batch(x, u))
_evaluate = eqx.filter_jit(lambda field, x, u: field(x, u))


def rollout_minibatch(
    field: AbstractVectorField, x0: Float[Array, "d b"], u: Float[Array, "t m b"], dt: float, solver: Solver
) -> Float[Array, "t d b"]:
    """The trajectories of a minibatch in training mode, features first: batch normalisation sees all windows."""
    if (states := kernels.trained(field, x0, u, dt, solver)) is not None:
        return states
    implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
    if (
        batch_norms(field) if implicit else as_field(field).features_first
    ):  # implicit and coupled: one system of equations
        return integrate(lambda x, held: _train(field, x, held), x0, u, dt, solver)
    alone = training_mode(field)  # samples first: transposing in each evaluation costs up to half the step

    def one_window(x0, u):
        return integrate(lambda x, held: _evaluate(alone, x, held), x0, u, dt, solver)

    return over_samples(one_window)(x0, u)


def predict(
    field: AbstractVectorField,
    x0: Float[Array | np.ndarray, "n d"],
    u: Float[Array | np.ndarray, "n t m"],
    dt: float,
    solver: Solver | None = None,
) -> Float[Array, "n t d"]:
    """`rollout_batch` by the kernels where available; equal to rounding, with the same errors."""
    by_kernels = np.ndim(u) == 3 and np.shape(u)[1] <= LONG  # they do not project, see `integrate.projection`
    states = kernels.predicted(field, x0, u, dt, RK4() if solver is None else solver) if by_kernels else None
    return rollout_batch(field, x0, u, dt, solver) if states is None else states
