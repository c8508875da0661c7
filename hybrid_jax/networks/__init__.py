"""Residual networks f_d.

`mlp` defines the network of the paper and linear maps, `activations` what its hidden units are, `normalisation` its
scaling and what its hidden layer may be normalised by, `standardise` sets the scaling from windows, `views` restrict
what a multirotor's network reads and returns, and `factory` builds these by name. `grids` has the same network at every
point of a grid.
"""

from hybrid_jax.networks.factory import make_residual
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
from hybrid_jax.networks.views import RotorThrust

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
