"""Flights in which the vehicle changes in the air: one program for each kind of estimator, run before and after it."""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from rich.console import Console

from experiments.closed_loop.flights import PATHS, WIDTH
from experiments.online import agents
from experiments.online.agents import CHANGES, PARTS
from experiments.runner.progress import Line
from hybrid_jax.control import Controller, Hardware, Loop, sample
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import with_disturbance
from hybrid_jax.estimation.least_squares import fit_least_squares
from hybrid_jax.online.estimator import OnlineAdaptation
from hybrid_jax.sim.domain import Quadrotor
from hybrid_jax.sim.flight import CLOCK, fly
from hybrid_jax.sim.forces import Parameters, Wrench, drag, ground_effect, weak_rotor, wind
from hybrid_jax.state import POSITION
from hybrid_jax.sweep.lanes import LaneMap, lane, stack
from hybrid_jax.trajectories import Trajectories, windows_of
from hybrid_jax.vehicle import IRIS

FORCES = (drag, ground_effect, wind, weak_rotor)
CHANGE = 4.0  # s, when the vehicle changes
WINDOW = 10  # periods of a window of least squares
SHOWN_EVERY = 2  # periods between two samples that are kept for figures
SHARED = {"unadapted": "unadapted", "least_squares": "unadapted", "oracle": "unadapted"}  # the same before the change


class Half(NamedTuple):
    """Half a flight: the part before or after the change."""

    estimator: Any
    start: Any  # a `Moment`
    vehicle: Parameters
    shares: Float[Any, " f"]  # of each of FORCES, 1 where it acts
    path: Int[Any, ""]
    clock: Float[Any, ""]  # of the wind when the flight began [s]
    first: Int[Any, ""]  # period


class Flown(NamedTuple):
    """A flight after the change: numbers at each period."""

    error: Float[Any, " t"]  # distance from the reference [m]
    altitude: Float[Any, " t"]  # m
    states: Float[Any, "s 13"]
    theta: Float[Any, "t p"]  # estimated change of θ in the physics' own parametrisation; nothing if not adapted
    std: Float[Any, "t p"]
    nis: Float[Any, " t"]
    changes: Float[Any, " t"]


class Setting(NamedTuple):
    """What all flights have in common."""

    controller: Controller
    hardware: Hardware
    references: Float[np.ndarray, "k n 13"]  # of all PATHS
    periods: int  # of half a flight

    @property
    def period(self) -> float:
        return self.controller.period


def setting(hardware: Hardware, seconds: float) -> Setting:
    """Flights of CHANGE + seconds; both halves run the same program, so that the first is as long as the second."""
    controller = Controller(IRIS, rotor_lag=hardware.rotor_lag)
    periods = round(seconds / controller.period)
    references = [np.asarray(sample(path, controller, 2 * seconds + 1)) for path in PATHS.values()]
    return Setting(controller, hardware, np.stack(references), periods)


def plant_of(half: Half, period: float):
    """The simulated vehicle, as a function that `Loop.tick` takes."""

    def force(x, u, t, parameters) -> Wrench:
        wrenches = [each(x, u, t, parameters) for each in FORCES]
        return Wrench(*(jnp.tensordot(half.shares, jnp.stack(parts), 1) for parts in zip(*wrenches, strict=True)))

    truth = Quadrotor(half.vehicle, (force,))
    return lambda x, u, t: truth.step(x, u, t + half.clock, period)


def simulate(own: Setting, half: Half, references: Float[Array, "k n 13"]):
    """Fly half a flight; returns where it ended and what is known of it."""
    loop = Loop(own.controller, own.hardware, half.estimator)
    plant, reference = plant_of(half, own.period), references[half.path]

    def tick(now, i):
        after = loop.tick(plant, reference, now, i)[0]
        error = jnp.linalg.norm((after.x - reference[i + 1])[POSITION])
        return after, (error, after.x, learned(half.estimator, after.estimate))

    end, (error, x, known) = jax.lax.scan(tick, half.start, half.first + jnp.arange(own.periods))
    return end, Flown(error, x[:, 2], x[::SHOWN_EVERY], *known)


def learned(estimator, state) -> tuple[Array, ...]:
    """θ, its standard deviation, NIS and changes found; zeros for an agent that does not estimate them."""
    if not isinstance(estimator, OnlineAdaptation):
        return jnp.zeros(0), jnp.zeros(0), jnp.zeros(()), jnp.zeros(())
    theta, covariance = estimator.estimate(state)
    return theta, jnp.sqrt(jnp.diagonal(covariance)), state.nis, state.changes


def before(own: Setting, name: str, path: str, seed: int, key, bandwidths: Mapping[str, float]) -> Half:
    """The first half of a flight; agents that are the same before the change share it."""
    clock: Any = np.float32(np.random.default_rng(seed).uniform(0, CLOCK))
    field = agents.nominal()
    estimators = {
        "unadapted": lambda: agents.told(field, own.period, clock),
        "observer": lambda: agents.told(field, own.period, clock, bandwidths["observer"]),
        "l1": lambda: agents.L1(field, 5.0, np.asarray(bandwidths["l1"], np.float32), own.period),
        "online": lambda: agents.online(own.hardware, own.period),
    }
    estimator, index = estimators[name](), list(PATHS).index(path)
    start = Loop(own.controller, own.hardware, estimator).begin(
        jnp.asarray(own.references[index, 0]), own.controller.begin(), key
    )
    return agents.as_numpy(
        Half(estimator, start, *world("nothing"), np.asarray(index, np.int32), clock, np.asarray(0, np.int32))
    )


def world(change: str) -> tuple[Parameters, Float[np.ndarray, " f"]]:
    """The true vehicle, and which of FORCES act."""
    domain = CHANGES[change]
    parameters = agents.as_numpy(domain.quadrotor().parameters)
    return parameters, np.array([force in domain.forces for force in FORCES], np.float32)


def after(own: Setting, first: Half, moment: Any, change: str, estimator: Any) -> Half:
    """The second half: another vehicle, and an estimator that may know more."""
    vehicle, shares = world(change)
    start = np.asarray(own.periods, np.int32)
    return first._replace(estimator=estimator, start=moment, vehicle=vehicle, shares=shares, first=start)


def ground_fits(change: str, seeds: int, hardware: Hardware) -> AbstractVectorField:
    """`nominal` with a disturbance, fitted to ten seconds of random flight after a change, stacked over seeds."""
    flights = fly(CHANGES[change], seeds, 10.0, jax.random.key(sum(map(ord, change))))
    noisy = jax.vmap(jax.vmap(hardware.measure))(
        jnp.asarray(flights.states, jnp.float32),
        jax.random.split(jax.random.key(1), flights.states.shape[:2]),
    )
    field = with_disturbance(agents.nominal())

    @eqx.filter_jit
    def fit(windows: Trajectories):
        return fit_least_squares(field, windows).field

    found = [
        fit(windows_of(np.asarray(states), np.asarray(inputs, np.float32), 0.01, steps=WINDOW))
        for states, inputs in zip(noisy, flights.inputs, strict=True)
    ]
    return stack([agents.as_numpy(each) for each in found])


class Program:
    """Half flights of one kind of estimator on all devices."""

    def __init__(self, own: Setting, most: int):
        width = min(WIDTH.get(jax.default_backend(), most), most)
        self.map = LaneMap(partial(simulate, own), width, min_capacity=most, compiler=None)
        self.shared = (own.references,)

    def __call__(self, halves: Sequence[Half], active: bool = True):
        return self.map(stack(halves), self.shared, np.ones(len(halves)), range(len(halves) if active else 0))


def kinds(names: Sequence[str]) -> dict[str, list[str]]:
    """Agents by the kind of their estimator, of those that fly."""
    found = {"told": ["unadapted", "observer", "least_squares", "oracle"], "l1": ["l1"], "online": ["online"]}
    return {kind: own for kind, of in found.items() if (own := [name for name in of if name in names])}


class Run(NamedTuple):
    """All flights: tags of each, results stacked in that order, and times."""

    tags: list[dict[str, Any]]
    flown: Flown
    beginnings: dict[tuple[str, str, int], Flown]  # before the change, by agent, reference and seed
    seconds: dict[str, float]  # on the clock, of each stage
    processor_seconds: float = math.nan  # of all flights, on all cores, without compiling


class Fleet(NamedTuple):
    """What flies, before it flies."""

    own: Setting
    changes: Sequence[str]
    firsts: Mapping[str, Mapping[tuple[str, int], Half]]  # by agent, then by reference and seed
    fitted: Mapping[str, Any]  # by least squares on the ground, by change

    def first_spots(self, members: Sequence[str]) -> list[tuple[str, str, int]]:
        """Agent, reference and seed of each flight before the change that these agents need."""
        names = dict.fromkeys(SHARED.get(name, name) for name in members)
        return [(name, *place) for name in names for place in self.firsts[name]]

    def begun(self, members: Sequence[str]) -> list[Half]:
        return [self.firsts[name][path, seed] for name, path, seed in self.first_spots(members)]

    def second_spots(self, members: Sequence[str]) -> list[tuple[str, str, str, int]]:
        """Agent, change, reference and seed of each flight after the change."""
        places = next(iter(self.firsts.values()))
        return [(name, change, *place) for name in members for change in self.changes for place in places]

    def second(self, spot: tuple[str, str, str, int], moment: Any) -> Half:
        """The flight after the change, from where the one before it ended."""
        name, change, path, seed = spot
        first = self.firsts[SHARED.get(name, name)][path, seed]
        return after(self.own, first, moment, change, changed(self.own, name, change, seed, first, self.fitted))


def flown(
    own: Setting,
    names: Sequence[str],
    changes: Sequence[str],
    references: Sequence[str],
    seeds: int,
    bandwidths: Mapping[str, float],
    console: Console,
) -> Run:
    """Fly every agent along every reference, through every change, with every seed."""
    seconds: dict[str, float] = {}
    fitted: dict[str, Any] = {}
    if "least_squares" in names:
        with _stage("least squares on the ground", seconds, console) as line:
            for change in changes:
                line.say(change)
                fitted[change] = ground_fits(change, seeds, own.hardware)
    keys = jax.random.split(jax.random.PRNGKey(0), len(references) * seeds).reshape(len(references), seeds, -1)
    places = {(path, seed): keys[i, seed] for i, path in enumerate(references) for seed in range(seeds)}
    firsts = {
        name: {place: before(own, name, *place, key, bandwidths) for place, key in places.items()}
        for name in dict.fromkeys(SHARED.get(name, name) for name in names)
    }
    fleet, found = Fleet(own, changes, firsts, fitted), kinds(names)
    programs = {kind: Program(own, len(fleet.second_spots(members))) for kind, members in found.items()}
    with _stage("compiling", seconds, console) as line, ThreadPoolExecutor(2) as pool:
        line.say(f"{len(programs)} programs")
        list(pool.map(lambda kind: programs[kind](fleet.begun(found[kind]), active=False), programs))
    tags, parts, beginnings, worked = [], [], {}, time.process_time()
    for kind, members in found.items():
        with _stage(f"flying {kind}", seconds, console) as line:
            line.say(f"{len(fleet.first_spots(members))} first halves")
            moments, early = programs[kind](fleet.begun(members))
            at = {spot: i for i, spot in enumerate(fleet.first_spots(members))}
            beginnings |= {spot: lane(early, i) for spot, i in at.items()}
            spots = fleet.second_spots(members)
            line.say(f"{len(spots)} second halves")
            ends = [lane(moments, at[SHARED.get(name, name), path, seed]) for name, _, path, seed in spots]
            parts.append(programs[kind]([fleet.second(*pair) for pair in zip(spots, ends, strict=True)])[1])
            tags += [dict(zip(("agent", "change", "reference", "seed"), spot, strict=True)) for spot in spots]
    together = Flown(*(np.concatenate(leaves) for leaves in zip(*map(widened, parts), strict=True)))
    return Run(tags, together, beginnings, seconds, time.process_time() - worked)


@contextmanager
def _stage(name: str, seconds: dict[str, float], console: Console) -> Iterator[Line]:
    """A line of progress, and how long it took."""
    began = time.perf_counter()
    with Line(name, console) as line:
        yield line
    seconds[name] = time.perf_counter() - began


def widened(flown: Flown) -> Flown:
    """With NaN for θ where nothing was estimated, so that all flights can be stacked."""
    size = PARTS + len(agents.DISTURBANCE)
    none = np.full((*flown.nis.shape, size), np.nan, np.float32)
    return flown if flown.theta.shape[-1] else flown._replace(theta=none, std=none)


def changed(own: Setting, name: str, change: str, seed: int, first: Half, fitted: Mapping[str, Any]) -> Any:
    """The estimator of the second half: that of the first, unless the agent was told something."""
    if name == "oracle":
        field = agents.as_numpy(agents.with_theta(agents.true_theta(CHANGES[change])))
        return agents.told(field, own.period, float(first.clock), share=float(wind in CHANGES[change].forces))
    if name == "least_squares":
        return agents.told(lane(fitted[change], seed), own.period, float(first.clock))
    return first.estimator
