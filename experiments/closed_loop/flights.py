"""Closed-loop flights, simulated and cached, with one program for each structure of prediction model."""

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.closed_loop.results import NUMBERS, TAGS, Agent, away
from experiments.flying import programs
from experiments.flying.plant import World, plant_of, world_of
from experiments.flying.scenario import PATHS, sampled
from experiments.reporting.results import Results
from experiments.runner.cache import identity_of
from experiments.runner.stages import Found, Stages
from hybrid_jax import control
from hybrid_jax.control import Controller, Hardware
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.io.files import Arrays
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, Domain
from hybrid_jax.sweep.lanes import LaneMap, count, lane
from hybrid_jax.vehicle import POSITION, STATE_SIZE

DOMAINS = (PARAMETER_SHIFT, EXTERNAL_FORCE)  # the two changes
CALL_EVERY = 50  # calls between two whose open-loop cost is computed
OFF = 0.005  # m
DRAW_EVERY = 5  # states between two that are kept for figures
SPENT = ("seconds", "processor_seconds", "devices")
ModelSet = Mapping[Agent, AbstractVectorField]  # stacked over seeds


class FlightSetup(NamedTuple):
    """The arrays that define one flight: `home` is the reference's offset [m], `bandwidth` the observer's [rad/s]."""

    model: AbstractVectorField
    world: World
    path: Int[Any, ""]
    home: Float[Any, "3"]
    bandwidth: Float[Any, ""]
    seed: Int[Any, ""]

    def structure(self) -> tuple:
        """The tree of the model, with shapes and dtypes: flights are stacked if it is equal."""
        leaves, tree = jax.tree.flatten(self.model)
        return tree, *((leaf.shape, leaf.dtype) for leaf in leaves)


@dataclass(frozen=True)
class Scenario:
    """Flights of a set of models in one domain along one of PATHS, at a `distance` from home [m] in x and y."""

    domain: Domain
    reference: str
    distance: float
    models: ModelSet
    bandwidth: float

    @property
    def name(self) -> str:
        return f"{self.domain.name} {self.reference}{away(self.distance).replace(',', '')}"

    def keys(self) -> list[tuple[Agent, int]]:
        return [(agent, seed) for agent, models in self.models.items() for seed in range(count(models))]

    def flights(self) -> Iterator[FlightSetup]:
        home = np.array([self.distance, self.distance, 0.0], np.float32) / np.float32(np.sqrt(2))
        world, path = world_of(self.domain), np.asarray(list(PATHS).index(self.reference), np.int32)
        for agent, seed in self.keys():
            bandwidth = np.asarray(self.bandwidth * agent.observer, np.float32)
            yield FlightSetup(lane(self.models[agent], seed), world, path, home, bandwidth, np.asarray(seed, np.int32))

    def described(self) -> list[Any]:
        """Describe all inputs of the results except controller and hardware; see `identity_of`."""
        return [self.name, self.bandwidth, [asdict(agent) for agent in self.models], *self.models.values()]


@dataclass(frozen=True)
class Flown:
    """The results of a scenario: arrays of `_simulate` by name, and the time without compiling, also on all cores."""

    scenario: Scenario
    arrays: Arrays
    seconds: float
    processor_seconds: float
    devices: int

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per flight: its tags, and NUMBERS, away from home only the RMSE."""
        place = {"reference": self.scenario.reference, "distance": self.scenario.distance}
        numbers = NUMBERS[:1] if self.scenario.distance else NUMBERS
        return [
            {"domain": self.scenario.domain.name, **asdict(agent), **place, "seed": seed}
            | {name: float(self.arrays[name][i].mean()) for name in numbers}
            | {"crashed": bool(self.arrays["crashed"][i])}
            for i, (agent, seed) in enumerate(self.scenario.keys())
        ]

    def states(self, agent: Agent, seed: int = 0) -> np.ndarray:
        return self.arrays["states"][self.scenario.keys().index((agent, seed))]


def results_of(scenarios: Sequence[Flown]) -> Results:
    return Results([row for each in scenarios for row in each.rows()], TAGS)


def fly_all(
    scenarios: list[Scenario], controller: Controller, seconds: float, stages: Stages, hardware: Hardware | None = None
) -> list[Flown]:
    """Simulate all scenarios, each a cached stage; the controller must have the hardware's rotor lag."""
    hardware = Hardware() if hardware is None else hardware
    references = sampled(controller, seconds)
    starts = references[:, 0].copy()
    spinning = list(PATHS).index("upset")
    starts[spinning] = control.add_body_rates(jnp.asarray(references[spinning, 0]))
    most: Counter[tuple] = Counter()  # programs have places for the largest scenario
    for scenario in scenarios:
        most |= Counter(flight.structure() for flight in scenario.flights())
    fly = partial(_fly, partial(_simulate, controller, hardware), most, {}, (references, starts))
    found = []
    for scenario in scenarios:
        name = f"flights {scenario.name}"
        identity = identity_of(asdict(controller), asdict(hardware), seconds, *scenario.described())
        ((_, arrays),) = stages.kept(name, {"": partial(fly, scenario)}, identity).values()
        found.append(Flown(scenario, arrays, *(arrays[key].item() for key in SPENT)))
    return found


def _fly(simulate, most: Mapping[tuple, int], made: dict[tuple, LaneMap], shared: tuple, scenario: Scenario) -> Found:
    """Simulate a scenario; return its results and SPENT, the time without compiling, and add programs to `made`."""
    groups, flights = defaultdict(list), list(scenario.flights())
    for i, flight in enumerate(flights):
        groups[flight.structure()].append(i)
    members = {key: [flights[i] for i in own] for key, own in groups.items()}
    new = {key: own for key, own in members.items() if key not in made}
    made.update(programs.compiled(simulate, new, most, shared))
    began, worked = time.perf_counter(), time.process_time()
    found = [programs.fly(made[key], own, shared) for key, own in members.items()]
    spent = time.perf_counter() - began, time.process_time() - worked, jax.device_count()
    order = np.argsort(np.concatenate(list(groups.values())))
    arrays = jax.tree.map(lambda *parts: np.concatenate(parts)[order], *found)
    return [], arrays | dict(zip(SPENT, map(np.asarray, spent), strict=True))


def _simulate(
    controller: Controller,
    hardware: Hardware,
    flight: FlightSetup,
    references: Float[Array, "k n 13"],
    starts: Float[Array, "k 13"],
) -> dict[str, Array]:
    """Fly one flight: `Performance`, open-loop costs of some calls and their relative error, and states."""
    offset = jnp.zeros(STATE_SIZE).at[POSITION].set(flight.home)
    reference, x0 = references[flight.path] + offset, starts[flight.path] + offset
    plant = plant_of(flight.world, controller.period)
    key = jax.random.fold_in(jax.random.key(flight.seed), flight.path) if any(hardware.noise) else None
    own = control.fly(plant, flight.model, reference, x0, controller, flight.bandwidth, hardware=hardware, key=key)
    calls = range(CALL_EVERY, len(own.u) - hardware.delay(controller.period), CALL_EVERY)
    predicted, actual = control.open_loop_costs(plant, own, reference, controller, calls, hardware)
    return {
        **vars(control.performance(own, reference, controller)),
        "promised": predicted,
        "realised": actual,
        "excess": cost_error(predicted, actual, controller),
        "states": own.x[::DRAW_EVERY],
    }


def cost_error(predicted: Float[Array, " c"], actual: Float[Array, " c"], controller: Controller) -> Float[Array, ""]:
    """(actual − predicted) / predicted, each summed over calls; a prediction near zero counts as plans OFF away."""
    weights = controller.weights
    floor = (controller.steps - 1 + weights.terminal**2) * (weights.position * OFF) ** 2
    return jnp.sum(actual - predicted) / jnp.maximum(jnp.sum(predicted), floor * len(predicted))
