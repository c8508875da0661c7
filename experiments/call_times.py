"""How long one call of the controller takes, alone: what a flight computer would have to do every 10 ms."""

import time

import equinox as eqx
import jax
import numpy as np

from hybrid_jax.control import Controller, advance, figure_eight, sample
from hybrid_jax.vector_field import AbstractVectorField

WARM = 10  # calls before the first that counts


def call_times(field: AbstractVectorField, controller: Controller, calls: int) -> dict[str, float]:
    """Of so many calls along a figure-8: median and 99th percentile on the clock, mean time of the processor [ms].

    Processor time counts all cores, so it is what one core would need; on a machine that does other work as well the
    clock says more than that.
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
