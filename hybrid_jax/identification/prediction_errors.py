"""Prediction errors of a model on flights."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from hybrid_jax import trajectories
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.hidden import DisturbanceModel
from hybrid_jax.estimation import observe
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.windows import cut_windows, flight_errors, sequences

UNITS = {"position": "m", "velocity": "m/s", "rotation": "rad", "body_rates": "rad/s"}


def rmse_by_flight(
    field: AbstractVectorField, logs: Sequence[FlightLog], steps: int
) -> Float[np.ndarray, "flights t 4"]:
    """Compute the RMSE in UNITS on each flight at the end of each interval."""
    return np.stack([rmse(errors_of(field, log, steps)) for log in logs])


def errors_of(field: AbstractVectorField, log: FlightLog, steps: int) -> Float[np.ndarray, "n t 4"]:
    """Compute the errors in UNITS for windows of a flight at the end of each interval."""
    if isinstance(field, DisturbanceModel):  # which starts from what was seen before
        parts = [(each, observe(field, each)[0]) for each in sequences([log], steps)]
        cut = [trajectories.windows_of(seen, np.asarray(each.u[0]), each.dt, steps=steps) for each, seen in parts]
        windows = trajectories.concatenate(cut)
    else:
        windows = cut_windows([log], steps, steps)
    return np.stack(flight_errors(field, windows), axis=-1)


def rmse(errors: Float[np.ndarray, "n t 4"]) -> Float[np.ndarray, "t 4"]:
    return np.sqrt(np.mean(np.square(errors), axis=0))


def ratio(errors: Float[np.ndarray, "*n 4"], others: Float[np.ndarray, "*n 4"]) -> float:
    return float(np.exp(np.log(errors / others).mean()))
