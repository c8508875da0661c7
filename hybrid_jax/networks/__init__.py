"""Residual networks f_d.

`mlp` defines the network of the paper and linear maps, `normalisation` what its hidden layer may be normalised by,
`views` and `rotor_thrust` restrict what a multirotor's network reads and returns, `factory` builds these by name, and
`fused` is the form that a controller evaluates.
"""

from hybrid_jax.networks.factory import make_residual
from hybrid_jax.networks.mlp import (
    InputScaling,
    LinearResidual,
    LinearSkip,
    ResidualNetwork,
    residual_network,
    zero_output,
)
from hybrid_jax.networks.normalisation import BatchNorm, Bias, LayerNorm
from hybrid_jax.networks.rotor_thrust import RotorThrust

__all__ = [
    "BatchNorm",
    "Bias",
    "InputScaling",
    "LayerNorm",
    "LinearResidual",
    "LinearSkip",
    "ResidualNetwork",
    "RotorThrust",
    "make_residual",
    "residual_network",
    "zero_output",
]
