"""Estimate the rotor time constant by minimising prediction error, for logs that record commands, not rotor speeds."""

from collections.abc import Callable, Sequence

import numpy as np

from hybrid_jax.flights.cleaning import lag_motors
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.motor_response import TIME_CONSTANTS


def choose_time_constant(
    logs: Sequence[FlightLog],
    error: Callable[[list[FlightLog]], float],
    candidates: Sequence[float] = tuple(TIME_CONSTANTS.tolist()),
) -> tuple[float, list[float]]:
    """Choose the time constant [s] with the smallest error; also return the error of each candidate.

    Args:
        error: prediction error of a model fitted to logs to which a candidate was applied.

    Raises:
        ValueError: no error is finite, or as `lag_motors`.
    """
    errors = [float(error([lag_motors(log, candidate)[0] for log in logs])) for candidate in candidates]
    if not np.isfinite(errors).any():
        raise ValueError("error is finite for no candidate, so no time constant can be chosen")
    return float(candidates[int(np.nanargmin(np.where(np.isfinite(errors), errors, np.nan)))]), errors
