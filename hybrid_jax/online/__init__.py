"""Online adaptation, one sample at a time: `OnlineAdaptation` is an extended Kalman filter of the parameters."""

from hybrid_jax.online.estimator import OnlineAdaptation
from hybrid_jax.online.hypotheses import Hypothesis
from hybrid_jax.online.state import Flags, OnlineState
from hybrid_jax.online.state_estimation import ExtendedKalmanFilter, StateEstimate
from hybrid_jax.online.tuning import Tuning

__all__ = ["ExtendedKalmanFilter", "Flags", "Hypothesis", "OnlineAdaptation", "OnlineState", "StateEstimate", "Tuning"]
