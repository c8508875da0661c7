"""Training: `fit` on one machine, one run; losses, objectives, learning-rate groups and stages.

A sweep of many runs in one program is in `hybrid_jax.sweep`.
"""

from hybrid_jax.training.channels import Channel, ChannelLoss, channels_from
from hybrid_jax.training.driver import FitInterrupted, FitResult, History, fit
from hybrid_jax.training.objective import Objective, Settings, TrajectoryLoss
from hybrid_jax.training.stages import Stage, fit_in_stages, rates_by_group

__all__ = ["Channel", "ChannelLoss", "FitInterrupted", "FitResult", "History", "Objective", "Settings", "Stage"]
__all__ += ["TrajectoryLoss", "channels_from", "fit", "fit_in_stages", "rates_by_group"]
