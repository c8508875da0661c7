"""Kernels in C++ for rollouts of many windows; where they do not serve, JAX does the same to rounding.

They serve single precision on a processor with AVX2. A run should be continued the way it began.
"""

from hybrid_jax.kernels.fields import REFUSED
from hybrid_jax.kernels.library import obstacle
from hybrid_jax.kernels.rollout import predicted as predicted
from hybrid_jax.kernels.rollout import serves_training as serves_training
from hybrid_jax.kernels.rollout import trained as trained

__all__ = ["status"]  # the rest is for the library's own modules


def status() -> str:
    """Whether kernels are used in this process: "used", or why not; and of which fields not, in a line for each."""
    if (reason := obstacle()) is not None:
        return f"not used: {reason}"
    return "\n".join(["used", *(f"not for {name}: {why}" for name, why in sorted(REFUSED.items()))])
