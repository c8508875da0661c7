"""Adapt a trained field to a few windows of a changed system, and say how well its parameters are known.

    source = hj.fit(hj.Hybrid(pendulum, network), train, validation, key)
    result = hj.adapt(source.best, windows)
    print(result.report())
    result.parameters["log_length"].value, result.parameters["log_length"].low

By default least squares fits the physical parameters θ_p and, if the windows need one, a constant disturbance; the
network stays as it is. `METHODS` lists the other methods by name; `Method` says how to write one.
"""

from hybrid_jax.adaptation.adapting import Adaptation, Parameter, adapt
from hybrid_jax.adaptation.expert_augmentation import Augmentation, ExpertAugmented, expert_augmented
from hybrid_jax.adaptation.least_squares import LeastSquaresFit, fit_least_squares
from hybrid_jax.adaptation.methods import METHODS, FineTune, LeastSquares, Method, Ridge, Solution, Source
from hybrid_jax.adaptation.uncertainty import (
    DisturbanceSelection,
    Interval,
    covariance_of,
    intervals,
    select_disturbance,
)

__all__ = ["METHODS", "Adaptation", "Augmentation", "DisturbanceSelection", "ExpertAugmented", "FineTune", "Interval"]
__all__ += ["LeastSquares", "LeastSquaresFit", "Method", "Parameter", "Ridge", "Solution", "Source"]
__all__ += ["adapt", "covariance_of", "expert_augmented", "fit_least_squares", "intervals", "select_disturbance"]
