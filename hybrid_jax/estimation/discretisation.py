"""Check how much half the solver's step would change a fit: intervals do not include it, and a network learns it."""

from dataclasses import replace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, ravel_learned
from hybrid_jax.dynamics.by_product import fixed_residual
from hybrid_jax.dynamics.disturbance import physics_of, with_physics
from hybrid_jax.integrate import compact, rollout
from hybrid_jax.metrics import errors_in
from hybrid_jax.runtime import UNOPTIMISED, jit_by_size
from hybrid_jax.trajectories import Trajectories

Solver = diffrax.AbstractSolver | None  # of the rollouts; RK4 by default
Scale = Float[Array, " d"] | None  # the error of each state that counts as 1; without one, 1 in its own unit

MANY, SOME = 10_000, 1000  # of more than MANY windows, or SOME for a network, SOME are compared
NAMED = 50  # parameters; a field with more is a network
COARSE = 0.5  # standard errors by which half the step may move a parameter, or share of the predictions' errors
FINE = 1e-3  # of the states' motion: the smallest error that counts as noise
REMEDY = "windows with a smaller dt, or a solver with more substeps, such as RK4(substeps=2)"


def discretisation(
    field: AbstractVectorField, windows: Trajectories, solver: Solver, scale: Scale, named: bool
) -> float:
    """Return how much half the solver's step would change a fit of these windows.

    Args:
        named: if True, the result is the largest move of a physical parameter in standard errors, or 0 if it is surely
            less than COARSE, since no parameter moves by more than all predictions together. If False, it is the
            change of the predictions over their errors, all of which a network can learn.
    """
    n = len(windows)
    some = windows if n <= (MANY if named else SOME) else windows[np.linspace(0, n - 1, SOME).astype(int)]
    fine = replace(some, x=np.repeat(some.x, 2, axis=1), u=np.repeat(some.u, 2, axis=1), dt=some.dt / 2)
    errors, halved = (np.asarray(errors_in(each, field, compact(solver)), float) for each in (some, fine))
    weight = np.where(np.isnan(some.x), 0, 1 / np.asarray(1 if scale is None else scale))
    parts = (halved[:, 1::2] - errors, errors, some.x - some.x0[:, None], some.x)
    change, error, moved, states = (np.linalg.norm(np.where(weight, each, 0) * weight) for each in parts)
    rounded = 2 * np.finfo(some.x.dtype).eps * states  # of both predictions
    if change <= rounded:
        return 0.0
    size = error + FINE * moved
    if not named:
        return float(change / size)
    noise = size / (np.count_nonzero(weight) * n / len(some)) ** 0.5
    if change <= COARSE * noise:
        return 0.0
    return float(_standard_errors(field, some, solver, weight, np.where(weight, parts[0], 0) * weight) / noise)


def compare_steps(
    field: AbstractVectorField, windows: Trajectories, solver: Solver, scale: Scale, named: bool | None = None
) -> float:
    """Return the `discretisation` of a field, by default of all that it learns, and warn if the step is too long."""
    if named is None:  # whether the field learns only a few parameters of physics, and no network
        named = 0 < ravel_learned(physics_of(field))[0].size == ravel_learned(field)[0].size <= NAMED
    moved = discretisation(field, windows, solver, scale, named)
    warn_of_steps(moved, REMEDY, named)
    return moved


def warn_of_steps(moved: float, remedy: str, named: bool = True) -> None:
    if moved > COARSE:
        what = f"move a parameter by {moved:.2g} standard" if named else f"change predictions by {moved:.2g} of their"
        checks.warn(f"half the solver's step would {what} errors: use {remedy}")


@jit_by_size(UNOPTIMISED)
def _standard_errors(field: AbstractVectorField, windows: Trajectories, solver: Solver, weight, change):
    """Return the largest move of a parameter by a change of the predictions, in standard errors for unit noise."""
    fixed = fixed_residual(field)
    theta, at = ravel_learned(physics_of(fixed))

    def predicted(theta):
        moved = with_physics(fixed, at(theta))
        return jax.vmap(lambda each: rollout(moved, each.x0, each.u, each.dt, compact(solver)))(windows)

    jacobian = (jax.jacfwd(predicted)(theta) * weight[..., None]).reshape(-1, theta.size)
    length = jnp.linalg.norm(jacobian, axis=0)
    jacobian = jacobian / jnp.where(length > 0, length, 1)
    inverse = jnp.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    error = jnp.sqrt(jnp.diagonal(inverse))
    return jnp.max(jnp.abs(inverse @ jacobian.T @ change.ravel()) / jnp.where(error > 0, error, 1), initial=0)
