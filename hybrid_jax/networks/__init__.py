"""Residual networks f_d: for any system, for parts of a multirotor's state, and for grids."""

from hybrid_jax.networks.grids import GridNetwork, grid_network
from hybrid_jax.networks.mlp import LinearResidual, ResidualNetwork, residual_network, smoothed, zero_output
from hybrid_jax.networks.normalisation import InputScaling
from hybrid_jax.networks.views import multirotor_network

__all__ = ["GridNetwork", "InputScaling", "LinearResidual", "ResidualNetwork", "grid_network", "multirotor_network"]
__all__ += ["residual_network", "smoothed", "zero_output"]
