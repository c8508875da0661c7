"""How long one call of the controller takes, alone: what a flight computer would have to do every 10 ms."""

import os
import signal
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

from hybrid_jax.control import Controller, advance, figure_eight, sample
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.runtime import configure

WARM = 10  # calls before the first that counts


def on_one_core(
    fields: Mapping[str, AbstractVectorField], controller: Controller, calls: int, cache: Path
) -> dict[str, dict[str, float]]:
    """`call_times` of each field, in a process that has one core of a CPU.

    A call's products are too small to share: a pool of threads that tries to costs more than it saves. A system that
    binds no process to a core (macOS) leaves it all of them.

    Args:
        cache: as of `runtime.configure`.
    """
    # Spawned, not forked: JAX runs threads here, and has fixed the devices.
    timed = partial(call_times, controller=controller, calls=calls)
    with ProcessPoolExecutor(1, get_context("spawn"), confined, (cache,)) as process:
        times = process.map(timed, map(jax.device_get, fields.values()))
        return dict(zip(fields, times, strict=True))


def confined(cache: Path) -> None:
    """Leave this process, which has made no array yet, one core; set JAX up with its programs in the cache."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to hear, and it ends this process
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    jax.config.update("jax_platforms", "cpu")
    configure(cache)


def call_times(field: AbstractVectorField, controller: Controller, calls: int) -> dict[str, float]:
    """Of so many calls along a figure-8: median and 99th percentile on the clock, mean time of the processor [ms].

    Processor time counts all cores; on a machine that does other work as well the clock says more than that.
    """
    control, simulate = eqx.filter_jit(controller), eqx.filter_jit(advance)
    reference = sample(figure_eight(3.5), controller, controller.period * (WARM + calls))
    plan, x = controller.begin(), reference[0]
    clocked, worked = [], []
    for i in range(WARM + calls):
        wanted = jax.block_until_ready(controller.horizon(reference, i))
        began, busy = time.perf_counter(), time.process_time()
        u, plan = jax.block_until_ready(control(field, wanted, x, plan))
        worked.append(time.process_time() - busy)
        clocked.append(time.perf_counter() - began)
        x = jax.block_until_ready(simulate(field, x, u, controller.period))
    clocked, worked = 1e3 * np.array(clocked[WARM:]), 1e3 * np.array(worked[WARM:])
    found = {"median_ms": np.median(clocked), "p99_ms": np.percentile(clocked, 99), "processor_ms": worked.mean()}
    return {name: float(value) for name, value in found.items()}
