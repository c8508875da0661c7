"""Prediction errors on recorded flight in position, velocity, rotation and body rates."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import rotation
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.runtime import entry
from hybrid_jax.trajectories import Trajectories, check
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, STATE_SIZE, VELOCITY

CHUNK = 500  # windows at a time
Errors = Float[Array | np.ndarray, "*n"]


class FlightErrors(NamedTuple):
    """The sizes of the errors of predicted states, each (n, t) for n windows of t intervals.

    Attributes:
        position: norm of the error [m].
        velocity: norm of the error [m/s].
        rotation: angle from the predicted attitude to the true one [rad], 0 … π.
        body_rates: norm of the error [rad/s].
    """

    position: Errors
    velocity: Errors
    rotation: Errors
    body_rates: Errors


def errors_between(predicted: Float[Array, "*n 13"], truth: Float[Array, "*n 13"]) -> FlightErrors:
    turns = jnp.vectorize(rotation.attitude_error, signature="(q),(q)->(v)")
    parts = [predicted[..., part] - truth[..., part] for part in (POSITION, VELOCITY, BODY_RATES)]
    parts.insert(2, turns(truth[..., QUATERNION], predicted[..., QUATERNION]))
    return FlightErrors(*(jnp.linalg.norm(part, axis=-1) for part in parts))


@entry
def flight_errors(field: AbstractVectorField, windows: Trajectories) -> FlightErrors:
    """Predict each window with a field in inference mode, and return the errors at the end of each interval.

    Args:
        field: the model.
        windows: measured states and inputs; the first 13 numbers of a state are as in `hybrid_jax.vehicle`.

    Raises:
        ValueError: if the windows are malformed, or their states are not a multirotor's.
    """
    if check(windows, "windows").x.shape[-1] < STATE_SIZE:
        raise ValueError(f"windows: states of {STATE_SIZE} expected, as in vehicle.py, got {windows.x.shape[-1]}")
    RIGID_BODY_SPACE.check("windows: x0", windows.x0)
    RIGID_BODY_SPACE.check("windows: x", windows.x)
    # The last part is padded, so that all flights share one program.
    parts = (np.arange(start, start + CHUNK) % len(windows) for start in range(0, len(windows), CHUNK))
    found = [jax.device_get(_errors(field, windows[part])) for part in parts]
    return FlightErrors(*(np.concatenate(arrays)[: len(windows)] for arrays in zip(*found, strict=True)))


@eqx.filter_jit
def _errors(field, windows: Trajectories) -> FlightErrors:
    predicted = rollout_batch(field, windows.x0, windows.u, windows.dt)
    return errors_between(*(each[..., :STATE_SIZE] for each in (predicted, jnp.asarray(windows.x))))
