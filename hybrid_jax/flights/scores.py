"""Prediction errors on recorded flight in position, velocity, rotation and body rates.

Two protocols use them: the RMSE over windows after 10, 50, … intervals, and that of the nanodrone benchmark, the mean
error of each of 50 steps from every sample, summed over steps.
"""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks, rotation
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, STATE_SIZE, VELOCITY
from hybrid_jax.trajectories import Trajectories, check, check_attitudes

Errors = Float[np.ndarray, "n t"]


class FlightErrors(NamedTuple):
    """An error for each quantity.

    Attributes:
        position: length of the error vector [m].
        velocity: the same [m/s].
        rotation: angle of the rotation from the predicted attitude to the true one [rad, 0 … π].
        body_rates: length of the error vector [rad/s].
    """

    position: Float[Array | np.ndarray, "*n"] | float
    velocity: Float[Array | np.ndarray, "*n"] | float
    rotation: Float[Array | np.ndarray, "*n"] | float
    body_rates: Float[Array | np.ndarray, "*n"] | float


def errors_between(predicted: Float[Array, "*n 13"], truth: Float[Array, "*n 13"]) -> FlightErrors:
    """Compute the error of each predicted state."""

    def length(part: slice):
        return jnp.linalg.norm(predicted[..., part] - truth[..., part], axis=-1)

    a, b = (rotation.normalise(states[..., QUATERNION]) for states in (predicted, truth))
    # |a − b| and |a + b| are 2 sin and 2 cos of a quarter of the angle, which is accurate for small angles.
    chords = jnp.linalg.norm(a - b, axis=-1), jnp.linalg.norm(a + b, axis=-1)
    angle = 4 * jnp.arctan2(jnp.minimum(*chords), jnp.maximum(*chords))  # q and −q are one rotation
    return FlightErrors(length(POSITION), length(VELOCITY), angle, length(BODY_RATES))


def flight_errors(
    field: AbstractVectorField,
    windows: Trajectories,
    solver: diffrax.AbstractSolver | None = None,
    chunk: int = 2000,
) -> FlightErrors:
    """Compute the errors (n, t) of a field in inference mode, for every window at the end of every interval.

    Args:
        chunk: number of windows that are predicted at a time.

    Raises:
        ValueError: malformed windows, or states other than those of a multirotor.
    """
    check(windows, "windows")
    checks.count("chunk", chunk)
    if windows.x.shape[-1] != STATE_SIZE:
        raise ValueError(f"windows: states of {STATE_SIZE} expected, as in state.py, got {windows.x.shape[-1]}")
    check_attitudes(windows, "windows")
    # The last part is padded, so that all parts share one program.
    parts = [np.arange(start, start + chunk) % len(windows) for start in range(0, len(windows), chunk)]
    if len(parts) == 1:
        parts = [np.arange(len(windows))]
    found = [jax.device_get(_errors(field, windows[part], solver)) for part in parts]
    return FlightErrors(*(np.concatenate(arrays)[: len(windows)] for arrays in zip(*found, strict=True)))


@eqx.filter_jit
def _errors(field, windows: Trajectories, solver) -> FlightErrors:
    predicted = rollout_batch(field, windows.x0, windows.u, windows.dt, solver)
    return errors_between(predicted, jnp.asarray(windows.x))


def mean_by_step(errors: FlightErrors) -> FlightErrors:
    """Average errors (n, t) over windows: the mean error (t,) at each step, as in the nanodrone protocol."""
    return FlightErrors(*(np.mean(part, axis=0, dtype=float) for part in errors))
