"""Simulate closed-loop flights: one compiled program for each structure of prediction model."""

import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.closed_loop.scenarios import FORCES, PATHS, Flight, Scenario
from experiments.runner.precompile import PrecompilePool
from hybrid_jax.control import (
    Controller,
    add_body_rates,
    fly,
    open_loop_costs,
    performance,
    relative_cost_error,
    sample,
)
from hybrid_jax.io.archive import Arrays
from hybrid_jax.sim.domain import Quadrotor
from hybrid_jax.sim.forces import Wrench
from hybrid_jax.state import POSITION, STATE_SIZE
from hybrid_jax.sweep.lanes import LaneMap, stack

WIDTH = {"cpu": 4}  # flights in one vmap; on another backend an even share of all
CALL_EVERY = 50  # calls between two whose open-loop cost is computed
DRAW_EVERY = 5  # states between two that are kept for figures


class ClosedLoopRunner:
    """Flies scenarios, which must all be given so that programs have places for the largest, with one controller."""

    def __init__(self, controller: Controller, seconds: float, scenarios: Sequence[Scenario]):
        references = np.stack([np.asarray(sample(path, controller, seconds)) for path in PATHS.values()])
        starts = references[:, 0].copy()
        spinning = list(PATHS).index("upset")
        starts[spinning] = add_body_rates(jnp.asarray(references[spinning, 0]))
        self.shared = (references, starts)
        most: Counter[tuple] = Counter()
        for scenario in scenarios:
            most |= Counter(map(structure, scenario.flights()))
        function = partial(simulate, controller)
        self._programs = {key: LaneMap(function, _width(n), min_capacity=n) for key, n in most.items()}

    def fly(self, scenario: Scenario) -> tuple[Arrays, dict[str, Any]]:
        """Results of all flights of a scenario, one per row, and the time they took without compiling [s]."""
        groups = defaultdict(list)
        flights = list(scenario.flights())
        for i, flight in enumerate(flights):
            groups[structure(flight)].append(i)
        runs = [
            partial(self._programs[key], stack([flights[i] for i in own]), self.shared, np.ones(len(own)))
            for key, own in groups.items()
        ]
        compiling = {str(i): partial(run, []) for i, run in enumerate(runs)}  # fly nothing
        with PrecompilePool(compiling) as pool:
            for name in compiling:
                pool.wait_for(name)
        for compiled in compiling.values():  # one after the other where the pool ignores them; errors are raised here
            compiled()
        began, worked = time.perf_counter(), time.process_time()
        found = [run(range(len(own))) for run, own in zip(runs, groups.values(), strict=True)]
        spent = {"seconds": time.perf_counter() - began, "processor_seconds": time.process_time() - worked}
        order = np.argsort(np.concatenate(list(groups.values())))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[order], *found), spent


def _width(flights: int) -> int:
    return min(WIDTH.get(jax.default_backend(), -(-flights // jax.device_count())), flights)


def structure(flight: Flight) -> tuple:
    """What flights must have in common to be stacked: the tree of the model, and its shapes and dtypes."""
    leaves, tree = jax.tree.flatten(flight.model)
    return tree, *((leaf.shape, leaf.dtype) for leaf in leaves)


def simulate(
    controller: Controller, flight: Flight, references: Float[Array, "k n 13"], starts: Float[Array, "k 13"]
) -> dict[str, Array]:
    """Fly one flight: `Performance`, open-loop costs of some calls and their relative error, and states."""
    offset = jnp.zeros(STATE_SIZE).at[POSITION].set(flight.home)
    reference, x0 = references[flight.path] + offset, starts[flight.path] + offset
    truth = Quadrotor(flight.vehicle, (_weighted_forces(flight.shares),))

    def plant(x, u, t):
        return truth.step(x, u, t, controller.period)

    flown = fly(plant, flight.model, reference, x0, controller, flight.bandwidth)
    costs = open_loop_costs(plant, flown, reference, controller, range(CALL_EVERY, len(flown.u), CALL_EVERY))
    return {
        **vars(performance(flown, reference, controller)),
        "promised": costs.predicted,
        "realised": costs.actual,
        "excess": relative_cost_error(costs, controller),
        "states": flown.x[::DRAW_EVERY],
    }


def _weighted_forces(shares: Float[Array, " f"]):
    """The sum of FORCES, each times its share."""

    def force(x, u, t, parameters) -> Wrench:
        wrenches = [each(x, u, t, parameters) for each in FORCES]
        return Wrench(*(jnp.tensordot(shares, jnp.stack(parts), 1) for parts in zip(*wrenches, strict=True)))

    return force
