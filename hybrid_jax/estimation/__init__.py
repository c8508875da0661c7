"""Estimate the parameters of a field by least squares through the ODE solver, with covariances and intervals.

You should use `fit_least_squares` if you measure whole states, and `fit_records` if you measure only some of them.
`estimate_windows` then makes windows for networks.
"""

from hybrid_jax.estimation.disturbances import fit_disturbance, observe
from hybrid_jax.estimation.least_squares import LeastSquaresFit, fit_least_squares
from hybrid_jax.estimation.record_fit import RecordFit, fit_records
from hybrid_jax.estimation.record_prediction import predict, simulate
from hybrid_jax.estimation.record_windows import RecordWindows, estimate_windows
from hybrid_jax.estimation.uncertainty import (
    DisturbanceSelection,
    Interval,
    covariance_of,
    intervals,
    select_disturbance,
)

__all__ = ["DisturbanceSelection", "Interval", "LeastSquaresFit", "RecordFit", "RecordWindows", "covariance_of"]
__all__ += ["estimate_windows", "fit_disturbance", "fit_least_squares", "fit_records", "intervals", "observe"]
__all__ += ["predict", "select_disturbance", "simulate"]
