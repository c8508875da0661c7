"""Predictions of many windows, and their L_MSE (paper, Sec. 3.3)."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks, kernels
from hybrid_jax.batches import in_chunks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.window_checks import continuous
from hybrid_jax.integrate import LONG, RK4, Solver, rollout_batch
from hybrid_jax.runtime import UNOPTIMISED, entry, jit_by_size
from hybrid_jax.trajectories import Trajectories, check, errors_of

CHUNK = 1000  # windows predicted at once


def predict(field: AbstractVectorField, x0, u, dt: float, solver: Solver | None = None) -> Float[Array, "n t d"]:
    """Call `rollout_batch`, or a kernel if there is one, with the same result to rounding and the same errors."""
    by_kernels = np.ndim(u) == 3 and np.shape(u)[1] <= LONG  # kernels do not project, see `integrate.projection`
    states = kernels.predicted(field, x0, u, dt, RK4() if solver is None else solver) if by_kernels else None
    return rollout_batch(field, x0, u, dt, solver) if states is None else states


@jit_by_size(UNOPTIMISED)
def errors_in(windows: Trajectories, field: AbstractVectorField, solver: Solver | None) -> Float[Array, "n t d"]:
    """Return x − x̂ of many windows, NaN where nothing was measured; for a field that is evaluated once or twice."""

    def errors(part: Trajectories):
        return jnp.asarray(part.x) - rollout_batch(field, part.x0, part.u, part.dt, solver)

    return in_chunks(errors, windows, CHUNK)


def mse(predicted: Float[Array, "*n t d"], truth: Float[Array, "*n t d"]) -> Float[Array, "*n"]:
    """Compute L_MSE = (1/T) Σ_t ‖x_t − x̂_t‖² of each window; ValueError if shapes differ or there is no state.

    Numbers that were not measured, NaN in `truth`, count as no error.

    Args:
        predicted: x̂, predicted states (n, t, d) or, for one window, (t, d).
        truth: x, the true states, which should have the same shape.
    """
    if predicted.shape != truth.shape or predicted.ndim < 2 or 0 in predicted.shape[-2:]:
        raise ValueError(f"predicted and truth must both be (n, t, d), got shapes {predicted.shape} and {truth.shape}")
    return jnp.mean(jnp.sum(jnp.square(errors_of(predicted, truth)), axis=-1), axis=-1)


@entry
def rollout_mse(
    field: AbstractVectorField, windows: Trajectories, every: int = 1, solver: Solver | None = None
) -> Float[Array, ""]:
    """Compute L_MSE of a field in inference mode, averaged over windows; it is not finite if a rollout diverges.

    Args:
        field: ẋ = f(x, u), evaluated in inference mode.
        windows: the windows, each predicted from its initial state.
        every: number of intervals from one compared state to the next.
        solver: a one-step method of diffrax; by default `RK4`. It should be the one used in training.

    Raises:
        ValueError: if windows are malformed or do not match the field, or `every` is beyond their horizon.
    """
    return jnp.mean(window_mse(field, windows, every, solver))


def window_mse(
    field: AbstractVectorField,
    windows: Trajectories,
    every: int = 1,
    solver: Solver | None = None,
    scale: Float[Array, " d"] | None = None,
) -> Float[Array, " n"]:
    """Compute L_MSE of each window; see `rollout_mse`.

    Args:
        field: ẋ = f(x, u), evaluated in inference mode.
        windows: n windows.
        every: number of intervals from one compared state to the next.
        solver: by default `RK4`.
        scale: a divisor for the error of each state; by default 1.
    """
    windows = continuous(field, check(windows, "windows", missing=True))
    checks.count("every", every)
    if every > windows.horizon:
        raise ValueError(f"every={every} is more than the {windows.horizon} intervals of the windows")

    def errors(windows: Trajectories) -> Float[Array, " n"]:
        predicted = predict(field, windows.x0, windows.u, windows.dt, solver)
        pair = (x if scale is None else x / scale for x in (predicted, jnp.asarray(windows.x)))
        return mse(*(x[:, every - 1 :: every] for x in pair))

    return in_chunks(errors, windows, CHUNK)
