"""Estimate the parameters of a field by least squares through the ODE solver, with covariances and intervals.

You should use `fit_least_squares` if you measure whole states, and `fit_records` if you measure only some of them.
"""

from hybrid_jax.estimation.disturbances import fit_disturbance, observe
from hybrid_jax.estimation.least_squares import LeastSquaresFit, fit_least_squares
from hybrid_jax.estimation.record_fit import RecordFit, fit_records
from hybrid_jax.estimation.record_prediction import predict, simulate
from hybrid_jax.estimation.uncertainty import (
    DisturbanceSelection,
    Interval,
    covariance_of,
    intervals,
    select_disturbance,
)

__all__ = ["DisturbanceSelection", "Interval", "LeastSquaresFit", "covariance_of", "fit_least_squares", "intervals"]
__all__ += ["RecordFit", "fit_disturbance", "fit_records", "observe", "predict", "select_disturbance", "simulate"]
