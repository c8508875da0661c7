"""Time of one call of the controller, which a flight computer would make every 10 ms."""

import time
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np

from hybrid_jax.control import Controller, advance, figure_eight, sample
from hybrid_jax.dynamics.base import AbstractVectorField

WARM_UP = 10  # calls that are not counted


def call_times(fields: Sequence[AbstractVectorField], controller: Controller, calls: int) -> list[dict[str, float]]:
    """For each field: median and 99th percentile of wall-clock time, mean processor time of all cores [ms]."""
    return [_call_times(field, controller, calls) for field in fields]


def _call_times(field: AbstractVectorField, controller: Controller, calls: int) -> dict[str, float]:
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
