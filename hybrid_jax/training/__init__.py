"""Training: `fit`, `fit_in_stages` and `fit_gauss_newton`, with their losses, objectives and learning rates."""

from hybrid_jax.training.driver import FitInterrupted, FitResult, History, fit
from hybrid_jax.training.gauss_newton import GaussNewtonFit, fit_gauss_newton
from hybrid_jax.training.objective import Objective, Settings, TrajectoryLoss
from hybrid_jax.training.stages import Stage, fit_in_stages, rates_by_group

__all__ = ["FitInterrupted", "FitResult", "GaussNewtonFit", "History", "Objective"]
__all__ += ["Settings", "Stage", "TrajectoryLoss", "fit", "fit_gauss_newton", "fit_in_stages"]
__all__ += ["rates_by_group"]
