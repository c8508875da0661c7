"""Residual networks f_d: that of the paper (`mlp`), parts of a multirotor's state (`views`), and grids (`grids`)."""

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
