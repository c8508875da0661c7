"""Programs that fly many flights at once, compiled once for each kind of flight."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from hybrid_jax.runtime import COMPILE_FLIGHTS, cores
from hybrid_jax.sweep.lanes import LaneMap, stack

WIDTH = {"cpu": 4}  # flights in one vmap; on another backend an even share of all


def compiled(
    simulate: Callable, kinds: Mapping[Any, Sequence[Any]], most: Mapping[Any, int], shared: tuple
) -> dict[Any, LaneMap]:
    """Compile a program for each kind of flight, of equal structure and shapes, for at most `most` flights at once."""
    programs = {}
    for kind in kinds:
        width = min(WIDTH.get(jax.default_backend(), -(-most[kind] // jax.device_count())), most[kind])
        programs[kind] = LaneMap(simulate, width, min_capacity=most[kind], compiler=COMPILE_FLIGHTS)
    # Processes of one run must compile in the same order.
    with ThreadPoolExecutor(cores() if jax.process_count() == 1 else 1) as pool:
        # By flying none: XLA computes a single chunk nevertheless, so no program is run twice for this.
        list(pool.map(lambda kind: fly(programs[kind], kinds[kind], shared, none=True), kinds))
    return programs


def fly(program: LaneMap, flights: Sequence[Any], shared: tuple, none: bool = False) -> Any:
    return program(stack(flights), shared, np.ones(len(flights)), range(0 if none else len(flights)))
