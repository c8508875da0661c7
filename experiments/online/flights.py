"""Flights in which the vehicle changes in the air, with one program for each kind of estimator before and after it."""

import math
import time
from collections.abc import Mapping
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.flying import programs
from experiments.flying.plant import World, plant_of, world_of
from experiments.flying.scenario import PATHS, sampled
from experiments.online import agents
from experiments.online.agents import CHANGES, PARTS
from experiments.online.config import OnlineConfig
from experiments.runner.stages import Stages
from hybrid_jax.control import Hardware, Loop
from hybrid_jax.dynamics import AbstractVectorField, with_disturbance
from hybrid_jax.estimation.least_squares import fit_least_squares
from hybrid_jax.online.estimator import OnlineAdaptation
from hybrid_jax.sim import flight as random_flight
from hybrid_jax.sim.forces import wind
from hybrid_jax.sweep.lanes import lane, stack
from hybrid_jax.trajectories import Trajectories, windows_of
from hybrid_jax.vehicle import POSITION

WINDOW = 10  # periods of a window of least squares
SAME_BEFORE = {"least_squares": "unadapted", "oracle": "unadapted"}  # agents that are another before the change
KINDS = {"fixed": ("unadapted", "observer", "least_squares", "oracle"), "l1": ("l1",), "online": ("online",)}


class Trial(NamedTuple):
    """The tags of a flight."""

    agent: str
    change: str
    reference: str
    seed: int

    @property
    def start(self) -> tuple[str, str, int]:
        """Agent, reference and seed of the segment before the change, which several trials share."""
        return SAME_BEFORE.get(self.agent, self.agent), self.reference, self.seed


class Segment(NamedTuple):
    """The part of a flight before or after the change, from the period `first` on."""

    estimator: Any
    moment: Any
    world: World
    path: Int[Any, ""]
    first: Int[Any, ""]


class Record(NamedTuple):
    """The record of a segment at each period: distances in m; `theta` is the change of θ, NaN without an estimate."""

    error: Float[Any, " t"]
    altitude: Float[Any, " t"]
    theta: Float[Any, "t p"]
    std: Float[Any, "t p"]
    changes: Float[Any, " t"]


class Run(NamedTuple):
    """All flights: records `after` the change, and `before` it by `Trial.start`; times exclude compiling."""

    trials: list[Trial]
    after: Record
    before: dict[tuple[str, str, int], Record]
    seconds: float = math.nan
    processor_seconds: float = math.nan


def simulate(config: OnlineConfig, segment: Segment, references: Float[Array, "k n 13"]):
    loop = Loop(config.controller(), config.hardware(), segment.estimator)
    plant, reference = plant_of(segment.world, loop.controller.period), references[segment.path]

    def estimated(state) -> tuple[Array, ...]:
        if not isinstance(segment.estimator, OnlineAdaptation):
            nothing = jnp.full(PARTS + len(agents.DISTURBANCE), jnp.nan)
            return nothing, nothing, jnp.zeros(())
        theta, covariance = segment.estimator.estimate(state)
        return theta, jnp.sqrt(jnp.diagonal(covariance)), state.changes

    def tick(now, i):
        after = loop.tick(plant, reference, now, i)[0]
        error = jnp.linalg.norm((after.x - reference[i + 1])[POSITION])
        return after, Record(error, after.x[2], *estimated(after.estimate))

    return jax.lax.scan(tick, segment.moment, segment.first + jnp.arange(config.periods))


def before(config: OnlineConfig, agent: str, path: str, seed: int, key, references) -> Segment:
    clock: Any = np.float32(np.random.default_rng(seed).uniform(0, random_flight.CLOCK))
    controller, hardware, field = config.controller(), config.hardware(), agents.nominal()
    period = controller.period
    if agent == "online":
        estimator = agents.online(hardware, period)
    elif agent == "l1":
        estimator = agents.L1(field, 5.0, np.asarray(config.l1_cutoff, np.float32), period)
    else:
        estimator = agents.fixed_model(field, period, clock, config.bandwidth if agent == "observer" else 0.0)
    index, loop = list(PATHS).index(path), Loop(controller, hardware, estimator)
    start = loop.begin(jnp.asarray(references[index, 0]), controller.begin(), key)
    world, zero = world_of(CHANGES["nothing"], clock), np.asarray(0, np.int32)
    return agents.as_numpy(Segment(estimator, start, world, np.asarray(index, np.int32), zero))


def after(config: OnlineConfig, trial: Trial, first: Segment, moment: Any, fitted: Mapping[str, Any]) -> Segment:
    """Return the segment after the change, with another vehicle and possibly an estimator with prior knowledge."""
    domain, clock, estimator = CHANGES[trial.change], float(first.world.clock), first.estimator
    period = config.controller().period
    if trial.agent == "oracle":
        field = agents.as_numpy(agents.with_theta(agents.true_theta(domain)))
        estimator = agents.fixed_model(field, period, clock, share=float(wind in domain.forces))
    if trial.agent == "least_squares":
        estimator = agents.fixed_model(lane(fitted[trial.change], trial.seed), period, clock)
    start = np.asarray(config.periods, np.int32)
    return Segment(estimator, moment, world_of(domain, clock), first.path, start)


def ground_fits(change: str, seeds: int, hardware: Hardware) -> AbstractVectorField:
    """Fit `nominal` with a disturbance to ten seconds of random flight after a change, stacked over seeds."""
    flights = random_flight.random_flights(CHANGES[change], seeds, 10.0, jax.random.key(sum(map(ord, change))))
    noisy = jax.vmap(jax.vmap(hardware.measure))(
        jnp.asarray(flights.states, jnp.float32), jax.random.split(jax.random.key(1), flights.states.shape[:2])
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


def fly_all(config: OnlineConfig, stages: Stages) -> Run:
    references = sampled(config.controller(), 2 * config.seconds + 1)
    fitted: dict[str, Any] = {}
    if "least_squares" in config.agents:
        jobs = [partial(ground_fits, change, config.seeds, config.hardware()) for change in config.changes]
        fitted = dict(zip(config.changes, stages.parts("least squares on the ground", jobs), strict=True))
    places = list(product(config.references, range(config.seeds)))
    # As plain arrays, of which segments are stacked.
    keys = dict(zip(places, jax.random.key_data(jax.random.split(jax.random.key(0), len(places))), strict=True))
    trials: dict[str, list[Trial]] = {}
    for kind, members in KINDS.items():
        if flying := [agent for agent in members if agent in config.agents]:
            tags = product(flying, config.changes, places)
            trials[kind] = [Trial(agent, change, *place) for agent, change, place in tags]
    firsts = {
        kind: {start: before(config, *start, keys[start[1:]], references) for start in {t.start: 0 for t in each}}
        for kind, each in trials.items()
    }
    kinds = {kind: list(each.values()) for kind, each in firsts.items()}
    most = {kind: len(each) for kind, each in trials.items()}
    compiled = partial(programs.compiled, partial(simulate, config), kinds, most, (references,))
    made = stages.timed("compiling", compiled, f"{len(kinds)} programs")
    early: dict[tuple[str, str, int], Record] = {}

    def fly(kind: str) -> Record:
        """Return the trials' records after the change, and store those before it in `early`."""
        moments, records = programs.fly(made[kind], kinds[kind], (references,))
        numbers = {start: i for i, start in enumerate(firsts[kind])}
        early.update({start: lane(records, i) for start, i in numbers.items()})
        segments = [
            after(config, trial, firsts[kind][trial.start], lane(moments, numbers[trial.start]), fitted)
            for trial in trials[kind]
        ]
        return programs.fly(made[kind], segments, (references,))[1]

    began, worked = time.perf_counter(), time.process_time()
    late = [stages.timed(f"flying {kind}", partial(fly, kind), f"{len(each)} flights") for kind, each in trials.items()]
    spent = time.perf_counter() - began, time.process_time() - worked
    together = Record(*(np.concatenate(leaves) for leaves in zip(*late, strict=True)))
    return Run([trial for each in trials.values() for trial in each], together, early, *spent)
