"""Closed-loop flights: which models fly which reference in which domain, simulated, and kept in the cache.

One program is compiled for each structure of prediction model; no flight is simulated twice.
"""

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from rich.console import Console

from experiments.closed_loop.results import NUMBERS, TAGS, Agent, away
from experiments.reporting.results import Results
from experiments.runner.progress import Line, clock
from hybrid_jax import control
from hybrid_jax.control import Controller, Hardware, sample
from hybrid_jax.control.cost import Scalar
from hybrid_jax.control.references import Path as Reference
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.io.archive import Arrays, digest, load_archive, named_leaves, save_archive
from hybrid_jax.io.datasets import versions
from hybrid_jax.io.files import backup_path
from hybrid_jax.io.models import describe
from hybrid_jax.runtime import cores
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, Domain, Quadrotor
from hybrid_jax.sim.forces import Parameters, Wrench
from hybrid_jax.state import POSITION, STATE_SIZE
from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.lanes import LaneMap, count, lane, stack

FORMAT = "hybrid_jax closed loop 1"
RECIPE = 7  # raise it when the same flights give other numbers
MADE_BY = ("jax", "hybrid_jax")
ALTITUDE = 1.5  # m
DOMAINS = (PARAMETER_SHIFT, EXTERNAL_FORCE)  # the two changes
FORCES = EXTERNAL_FORCE.forces  # all that act in any domain
WIDTH = {"cpu": 4}  # flights in one vmap; on another backend an even share of all
CALL_EVERY = 50  # calls between two whose open-loop cost is computed
DRAW_EVERY = 5  # states between two that are kept for figures
ModelSet = Mapping[Agent, AbstractVectorField]  # stacked over seeds


def _crossing(t: Scalar) -> tuple[Float[Array, "3"], Scalar]:
    """A low pass that crosses home after 5 s."""
    position, yaw = control.low_pass(speed=2.0)(t)
    return position - jnp.array([10.0, 0.0, 0.0]), yaw


PATHS: Mapping[str, Reference] = {
    "hover": control.hover((0.0, 0.0, ALTITUDE)),
    "figure_eight": control.figure_eight(3.5, altitude=ALTITUDE),
    "fast_figure_eight": control.figure_eight(6.0, altitude=ALTITUDE),
    "step": control.step((1.0, 1.0, 0.5), yaw=np.pi / 2, altitude=ALTITUDE),
    "low_pass": _crossing,
    "upset": control.hover((0.0, 0.0, ALTITUDE)),  # the initial state has a body rate
}


class Flight(NamedTuple):
    """The arrays that define one flight."""

    model: AbstractVectorField  # of the controller
    vehicle: Parameters  # the true one
    shares: Float[Any, " f"]  # of each of FORCES, 1 where it acts
    path: Int[Any, ""]  # index into PATHS
    home: Float[Any, "3"]  # offset of the reference [m, world]
    bandwidth: Float[Any, ""]  # of the disturbance observer [rad/s]; 0 for none
    seed: Int[Any, ""]  # of the noise, the same for all agents

    def structure(self) -> tuple:
        """What flights must have in common to be stacked: the tree of the model, and its shapes and dtypes."""
        leaves, tree = jax.tree.flatten(self.model)
        return tree, *((leaf.shape, leaf.dtype) for leaf in leaves)


@dataclass(frozen=True)
class Scenario:
    """Flights of a set of models in one domain along one of PATHS."""

    domain: Domain
    reference: str
    distance: float  # from home [m], equally far in x and y
    models: ModelSet
    bandwidth: float  # of the disturbance observers [rad/s]

    @property
    def name(self) -> str:
        return f"{self.domain.name} {self.reference}{away(self.distance).replace(',', '')}"

    def keys(self) -> list[tuple[Agent, int]]:
        """The agent and the seed of each flight."""
        return [(agent, seed) for agent, models in self.models.items() for seed in range(count(models))]

    def flights(self) -> Iterator[Flight]:
        """In the order of `keys`."""
        home = np.array([self.distance, self.distance, 0.0], np.float32) / np.float32(np.sqrt(2))
        vehicle = self.domain.quadrotor().parameters
        shares = np.array([force in self.domain.forces for force in FORCES], np.float32)
        path = np.asarray(list(PATHS).index(self.reference), np.int32)
        for agent, seed in self.keys():
            bandwidth = np.asarray(self.bandwidth * agent.observer, np.float32)
            noise = np.asarray(seed, np.int32)
            yield Flight(lane(self.models[agent], seed), vehicle, shares, path, home, bandwidth, noise)


@dataclass(frozen=True)
class Flown:
    """The results of a scenario."""

    scenario: Scenario
    arrays: Arrays  # by name, one value per flight; see `_simulate`
    seconds: float  # wall-clock time of the simulation, without compiling
    processor_seconds: float  # on all cores
    devices: int  # number of them

    def rows(self) -> list[dict[str, Any]]:
        """One row per flight: its tags and NUMBERS."""
        place = {"reference": self.scenario.reference, "distance": self.scenario.distance}
        return [
            {"domain": self.scenario.domain.name, **asdict(agent), **place, "seed": seed}
            | {name: float(self.arrays[name][i].mean()) for name in NUMBERS}
            | {"crashed": bool(self.arrays["crashed"][i])}
            for i, (agent, seed) in enumerate(self.scenario.keys())
        ]

    def states(self, agent: Agent, seed: int = 0) -> np.ndarray:
        """The states of one flight, every `DRAW_EVERY` periods."""
        return self.arrays["states"][self.scenario.keys().index((agent, seed))]


def results_of(scenarios: Sequence[Flown]) -> Results:
    return Results([row for each in scenarios for row in each.rows()], TAGS)


def flown(
    scenarios: list[Scenario],
    controller: Controller,
    seconds: float,
    folder: Path,
    console: Console,
    fresh: bool,
    hardware: Hardware | None = None,
) -> list[Flown]:
    """The results of all scenarios in flights of so many seconds, found in the cache `folder` or flown now.

    The hardware is that of `control.fly`; the controller must have its rotor lag. With `fresh`, results of other
    versions are moved aside and flown again.
    """
    hardware = Hardware() if hardware is None else hardware
    references = np.stack([np.asarray(sample(path, controller, seconds)) for path in PATHS.values()])
    starts = references[:, 0].copy()
    spinning = list(PATHS).index("upset")
    starts[spinning] = control.add_body_rates(jnp.asarray(references[spinning, 0]))
    shared = references, starts
    most: Counter[tuple] = Counter()  # programs have places for the largest scenario
    for scenario in scenarios:
        most |= Counter(flight.structure() for flight in scenario.flights())
    programs = {}
    for key, n in most.items():
        width = min(WIDTH.get(jax.default_backend(), -(-n // jax.device_count())), n)
        programs[key] = LaneMap(partial(_simulate, controller, hardware), width, min_capacity=n)
    compiled: set[tuple] = set()
    found = []
    for scenario in scenarios:
        path = (
            folder / f"{scenario.name.replace(' ', '-')}-{_identity(scenario, controller, hardware, shared)[:16]}.npz"
        )
        about, arrays = hosts.from_first(lambda path=path: _cached(path, console, fresh))
        origin = "as found in the cache"
        if about is None:
            with Line(scenario.name, console) as line:
                arrays, spent = _fly(scenario, programs, compiled, shared, line)
            about = spent | {"devices": jax.device_count(), "versions": versions(*MADE_BY)}
            origin = clock(about["seconds"])
            if hosts.is_main_process():
                save_archive(path, FORMAT, about, arrays)
        console.print(f"{scenario.name}: {len(scenario.keys())} flights, {origin}", highlight=False, soft_wrap=True)
        found.append(Flown(scenario, arrays, *(about[name] for name in ("seconds", "processor_seconds", "devices"))))
    return found


def _identity(scenario: Scenario, controller: Controller, hardware: Hardware, shared: tuple) -> str:
    """What the results depend on; without hardware as it was before there was any, so that they are found again."""
    models = list(scenario.models.values())
    fixed = [RECIPE, CALL_EVERY, DRAW_EVERY, asdict(controller), *map(describe, models)]
    fixed += [asdict(hardware)] if hardware != Hardware() else []
    flights = [flight._replace(model=None, seed=None) for flight in scenario.flights()]
    return digest(fixed, named_leaves({"flights": flights, "models": models, "shared": shared}))


def _cached(path: Path, console: Console, fresh: bool) -> tuple[dict[str, Any] | None, Arrays]:
    if not path.exists():
        return None, {}
    about, arrays = load_archive(path, FORMAT)
    if fresh and about["versions"] != versions(*MADE_BY):
        backup = path.rename(backup_path(path, "before"))
        console.print(f"{path}: moved aside to {backup.name}", highlight=False)
        return None, {}
    return about, arrays


def _fly(
    scenario: Scenario, programs: Mapping[tuple, LaneMap], compiled: set[tuple], shared: tuple, line: Line
) -> tuple[Arrays, dict[str, Any]]:
    """Results of all flights of a scenario, one per row, and the time they took without compiling [s].

    The structures of the programs that were compiled for them are added to `compiled`.
    """
    groups, flights = defaultdict(list), list(scenario.flights())
    for i, flight in enumerate(flights):
        groups[flight.structure()].append(i)
    runs = {
        key: partial(programs[key], stack([flights[i] for i in own]), shared, np.ones(len(own)))
        for key, own in groups.items()
    }
    new = [run for key, run in runs.items() if key not in compiled]
    line.say(f"compiling {len(new)} programs for {len(flights)} flights")
    # Processes of one run must compile in the same order.
    with ThreadPoolExecutor(cores() if jax.process_count() == 1 else 1) as pool:
        # Compile by flying nothing. XLA computes a single chunk nevertheless, so no program is run twice for this.
        list(pool.map(lambda run: run([]), new))
    compiled.update(runs)  # not |=, which for keys of a dict makes another set
    began, worked = time.perf_counter(), time.process_time()
    found, flown = [], 0
    for run, own in zip(runs.values(), groups.values(), strict=True):
        line.show_share("flying", flown / len(flights))
        found.append(run(range(len(own))))
        flown += len(own)
    spent = {"seconds": time.perf_counter() - began, "processor_seconds": time.process_time() - worked}
    order = np.argsort(np.concatenate(list(groups.values())))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[order], *found), spent


def _simulate(
    controller: Controller,
    hardware: Hardware,
    flight: Flight,
    references: Float[Array, "k n 13"],
    starts: Float[Array, "k 13"],
) -> dict[str, Array]:
    """Fly one flight: `Performance`, open-loop costs of some calls and their relative error, and states."""
    offset = jnp.zeros(STATE_SIZE).at[POSITION].set(flight.home)
    reference, x0 = references[flight.path] + offset, starts[flight.path] + offset

    def force(x, u, t, parameters) -> Wrench:
        wrenches = [each(x, u, t, parameters) for each in FORCES]
        return Wrench(*(jnp.tensordot(flight.shares, jnp.stack(parts), 1) for parts in zip(*wrenches, strict=True)))

    truth = Quadrotor(flight.vehicle, (force,))

    def plant(x, u, t):
        return truth.step(x, u, t, controller.period)

    key = jax.random.fold_in(jax.random.key(flight.seed), flight.path) if any(hardware.noise) else None
    own = control.fly(plant, flight.model, reference, x0, controller, flight.bandwidth, hardware=hardware, key=key)
    calls = range(CALL_EVERY, len(own.u) - hardware.delay(controller.period), CALL_EVERY)
    costs = control.open_loop_costs(plant, own, reference, controller, calls, hardware)
    return {
        **vars(control.performance(own, reference, controller)),
        "promised": costs.predicted,
        "realised": costs.actual,
        "excess": control.relative_cost_error(costs, controller),
        "states": own.x[::DRAW_EVERY],
    }
