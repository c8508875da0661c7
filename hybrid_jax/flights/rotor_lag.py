"""The rotors' time constant by what it does to a model's predictions, where the log tells what rotors were told.

`cleaning.follow_motors` finds it by correlation with the gyro in one log; this finds the one value for many logs with
which a model, fitted anew for each candidate, predicts best.
"""

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
    """The candidate [s] with the least error, and the error of each.

    Args:
        error: of logs whose motors follow with the candidate; fits and judges a model on them.

    Raises:
        ValueError: no error is finite, or what `cleaning.lag_motors` refuses.
    """
    errors = [float(error([lag_motors(log, candidate)[0] for log in logs])) for candidate in candidates]
    if not np.isfinite(errors).any():
        raise ValueError("error is finite for no candidate, so the time constant cannot be told")
    return float(candidates[int(np.nanargmin(np.where(np.isfinite(errors), errors, np.nan)))]), errors
