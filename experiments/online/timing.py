"""Time of one step of the filter, on one core."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from experiments.flying.timing import on_one_core
from experiments.online import agents
from hybrid_jax.control import Hardware
from hybrid_jax.runtime import FAST_COMPILE, jit_with
from hybrid_jax.vehicle import IRIS

STEPS = 1000  # that are timed


def step_time(hardware: Hardware, period: float) -> float:
    """Processor time of a step of the filter on one core, for the Iris [ms]."""
    return on_one_core(_step_time, hardware, period)


def _step_time(hardware: Hardware, period: float) -> float:
    adaptation = agents.online("iris", hardware, period)
    start = jnp.zeros(13).at[2].set(1.5).at[3].set(1.0)
    noise = 0.01 * jax.random.normal(jax.random.key(0), (STEPS, 13))
    u = jnp.full(IRIS.rotors, IRIS.hover_speed)

    @jit_with(FAST_COMPILE)
    def steps(state):
        return jax.lax.scan(lambda state, e: (adaptation.update(state, start + e, u), None), state, noise)[0]

    state = jax.block_until_ready(steps(adaptation.begin(start)))
    taken = []
    for _ in range(5):
        began = time.process_time()
        state = jax.block_until_ready(steps(state))
        taken.append(time.process_time() - began)
    return 1e3 * float(np.median(taken)) / STEPS
