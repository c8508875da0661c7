"""Where and with what a result was made."""

import os
import platform
from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

from hybrid_jax.io.datasets import versions

PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "optax", "mujoco", "mujoco-mjx", "numpy", "hybrid_jax")


def environment(stages: Mapping[str, float]) -> dict[str, Any]:
    """Versions, hardware, seconds of each stage and the date (UTC, ISO 8601), as JSON values."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(*PACKAGES),
        "hardware": hardware(),
        "seconds": {stage: round(float(seconds), 3) for stage, seconds in stages.items()},
    }


def hardware() -> dict[str, Any]:
    """Processor, cores, memory [GiB], and the devices JAX computes on."""
    devices = Counter(device.device_kind for device in jax.devices())
    return {
        "cpu": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": _memory(),
        "jax_backend": jax.default_backend(),
        "jax_devices": [f"{count} × {kind}" for kind, count in devices.items()],
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def _memory() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, ValueError, OSError):  # not POSIX
        return None
