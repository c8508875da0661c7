"""Kernels in C++ for rollouts of many windows; where they do not serve, JAX does the same to rounding.

They serve single precision on a processor with AVX2. A run should be continued the way it began.
"""

from hybrid_jax.kernels.fields import predicted as predicted
from hybrid_jax.kernels.fields import serves_training as serves_training
from hybrid_jax.kernels.fields import trained as trained
from hybrid_jax.kernels.library import obstacle

__all__ = ["status"]


def status() -> str:
    """Whether kernels are used in this process: "used", or why not. Compiles them if need be."""
    reason = obstacle()
    return "used" if reason is None else f"not used: {reason}"
