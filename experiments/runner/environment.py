"""The versions, the hardware and the time behind a result."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from hybrid_jax.io.datasets import versions
from hybrid_jax.runtime import hardware

PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "optax", "mujoco", "mujoco-mjx", "numpy", "hybrid_jax")


def environment(stages: Mapping[str, float]) -> dict[str, Any]:
    """Versions, hardware, seconds of each stage and the date (UTC, ISO 8601), as JSON values."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(*PACKAGES),
        "hardware": hardware(),
        "seconds": {stage: round(float(seconds), 3) for stage, seconds in stages.items()},
    }
