"""Time of one call of the controller, which a flight computer would make every 10 ms."""

import os
import signal
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import equinox as eqx
import jax
import numpy as np

from hybrid_jax.control import Controller, advance, figure_eight, sample
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.runtime import configure

WARM_UP = 10  # calls that are not counted


def on_one_core(
    fields: Mapping[str, AbstractVectorField], controller: Controller, calls: int
) -> dict[str, dict[str, float]]:
    """`call_times` of each field, in a process with one CPU core: more do not make its small matrix products faster.

    A system that cannot bind a process to a core (macOS) leaves it all of them.
    """
    # Spawned, not forked: JAX already runs threads here and has fixed the devices.
    timed = partial(call_times, controller=controller, calls=calls)
    with ProcessPoolExecutor(1, get_context("spawn"), use_one_core) as process:
        times = process.map(timed, map(jax.device_get, fields.values()))
        return dict(zip(fields, times, strict=True))


def use_one_core() -> None:
    """Bind this process to one core and configure JAX, before its first array."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends this process
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    jax.config.update("jax_platforms", "cpu")
    configure()


def call_times(field: AbstractVectorField, controller: Controller, calls: int) -> dict[str, float]:
    """Calls along a figure-8: median and 99th percentile of wall-clock time, mean processor time of all cores [ms]."""
    control, simulate = eqx.filter_jit(controller), eqx.filter_jit(advance)
    reference = sample(figure_eight(3.5), controller, controller.period * (WARM_UP + calls))
    plan, x = controller.begin(), reference[0]
    clocked, worked = [], []
    for i in range(WARM_UP + calls):
        wanted = jax.block_until_ready(controller.horizon(reference, i))
        began, busy = time.perf_counter(), time.process_time()
        u, plan = jax.block_until_ready(control(field, wanted, x, plan))
        worked.append(time.process_time() - busy)
        clocked.append(time.perf_counter() - began)
        x = jax.block_until_ready(simulate(field, x, u, controller.period))
    clocked, worked = 1e3 * np.array(clocked[WARM_UP:]), 1e3 * np.array(worked[WARM_UP:])
    median, p99 = np.percentile(clocked, [50, 99])
    return {"median_ms": float(median), "p99_ms": float(p99), "processor_ms": float(worked.mean())}
