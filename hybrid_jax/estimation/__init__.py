"""Estimate the parameters of a field from windows by least squares through the ODE solver, and say how well.

`least_squares` fits, `normal_equations` linearises around a fit, `uncertainty` gives covariances and intervals.
`record_fit` does the same from records of which not every state was measured.
"""

from hybrid_jax.estimation.least_squares import LeastSquaresFit, fit_least_squares
from hybrid_jax.estimation.record_fit import RecordFit, fit_records, predict, simulate
from hybrid_jax.estimation.uncertainty import (
    DisturbanceSelection,
    Interval,
    covariance_of,
    intervals,
    select_disturbance,
)

__all__ = ["DisturbanceSelection", "Interval", "LeastSquaresFit", "covariance_of", "fit_least_squares", "intervals"]
__all__ += ["select_disturbance"]
__all__ += ["RecordFit", "fit_records", "predict", "simulate"]
