"""Residual networks f_d: the paper's (`mlp`), on parts of a multirotor's state (`views`) and on grids (`grids`)."""

from hybrid_jax.networks.grids import GridNetwork, grid_network
from hybrid_jax.networks.mlp import (
    InputScaling,
    LinearResidual,
    LinearSkip,
    ResidualNetwork,
    residual_network,
    smoothed,
    zero_output,
)
from hybrid_jax.networks.normalisation import BatchNorm, Bias, LayerNorm
from hybrid_jax.networks.views import RotorThrust, make_residual

__all__ = ["BatchNorm", "Bias", "InputScaling", "LayerNorm", "LinearResidual", "LinearSkip", "ResidualNetwork"]
__all__ += [
    "GridNetwork",
    "RotorThrust",
    "grid_network",
    "make_residual",
    "residual_network",
    "smoothed",
    "zero_output",
]
