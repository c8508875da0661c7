"""C++ kernels for rollouts of many windows in single precision with AVX2. JAX gives the same result to rounding."""

import os

from hybrid_jax.kernels.fields import UNSUPPORTED
from hybrid_jax.kernels.library import SWITCH, obstacle
from hybrid_jax.kernels.rollout import predicted as predicted
from hybrid_jax.kernels.rollout import serves_training as serves_training
from hybrid_jax.kernels.rollout import trained as trained

__all__ = ["status"]  # the rest is for the library's own modules


def switch_off() -> None:
    """Disable kernels for later compilations in this process and its children, like HYBRID_JAX_NATIVE=0."""
    os.environ[SWITCH] = "0"
    obstacle.cache_clear()


def status() -> str:
    """Return whether this process uses kernels ("used" or why not), with a line for each unsupported field."""
    if (reason := obstacle()) is not None:
        return f"not used: {reason}"
    return "\n".join(["used", *(f"not for {name}: {why}" for name, why in sorted(UNSUPPORTED.items()))])
