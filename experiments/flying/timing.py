"""Times on one core, as on a flight computer."""

import os
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeVar

import jax

from hybrid_jax.runtime import configure

Result = TypeVar("Result")


def on_one_core(function: Callable[..., Result], *arguments: object) -> Result:
    """Call a function in a process with one core, if the system can bind it (macOS cannot)."""
    # Spawned, not forked: JAX already runs threads here and has fixed the devices.
    with ProcessPoolExecutor(1, get_context("spawn"), _use_one_core) as process:
        return process.submit(function, *arguments).result()


def _use_one_core() -> None:
    """Bind this process to one core and configure JAX, before its first array."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends this process
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    jax.config.update("jax_platforms", "cpu")
    configure()
