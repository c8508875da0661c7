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
from experiments.flying.scenario import PATHS, sampled
from experiments.online import agents
from experiments.online.agents import PARTS
from experiments.online.config import OnlineConfig
from experiments.online.worlds import Equations, ground_flights, is_rotorpy, plant_of, truth_of
from experiments.runner.stages import Stages
from experiments.worlds.iris import domain_of
from experiments.worlds.world import DT, NOTHING
from hybrid_jax.control import Loop
from hybrid_jax.dynamics import AbstractVectorField, with_disturbance
from hybrid_jax.estimation.least_squares import fit_least_squares
from hybrid_jax.online.estimator import OnlineAdaptation
from hybrid_jax.sim import flight as random_flight
from hybrid_jax.sim.forces import wind
from hybrid_jax.sweep.lanes import lane, stack
from hybrid_jax.trajectories import Trajectories, windows_of
from hybrid_jax.vehicle import POSITION

WINDOW = 10  # periods of a window of least squares
KINDS = {"l1": "l1", "online": "online"}  # of programs by agent; all other agents have a fixed model


class Trial(NamedTuple):
    """The tags of a flight."""

    world: str
    agent: str
    change: str
    reference: str
    seed: int

    @property
    def kind(self) -> str:
        own = self.agent == "oracle" and is_rotorpy(self.world)
        return "oracle" if own else KINDS.get(self.agent, "fixed")

    @property
    def start(self) -> tuple[str, str, int]:
        """Agent, reference and seed of the segment before the change, which several trials share."""
        same = self.kind == "fixed" and self.agent != "observer"
        return "unadapted" if same else self.agent, self.reference, self.seed


class Segment(NamedTuple):
    """The part of a flight before or after the change, from the period `first` on."""

    estimator: Any
    moment: Any
    truth: Any
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
    """All flights: records `after` the change; times exclude compiling."""

    trials: list[Trial]
    after: Record
    seconds: float = math.nan
    processor_seconds: float = math.nan


def simulate(config: OnlineConfig, world: str, segment: Segment, references: Float[Array, "k n 13"]):
    loop = Loop(config.controller(world), config.hardware(world), segment.estimator)
    reference, lag = references[segment.path], loop.hardware.rotor_lag

    def estimated(state) -> tuple[Array, ...]:
        if not isinstance(segment.estimator, OnlineAdaptation):
            nothing = jnp.full(PARTS + 6, jnp.nan)
            return nothing, nothing, jnp.zeros(())
        theta, covariance = segment.estimator.estimate(state)
        return theta, jnp.sqrt(jnp.diagonal(covariance)), state.changes

    def tick(now, i):
        after = loop.tick(plant_of(segment.truth, now.speeds, lag), reference, now, i)[0]
        error = jnp.linalg.norm((after.x - reference[i + 1])[POSITION])
        return after, Record(error, after.x[2], *estimated(after.estimate))

    return jax.lax.scan(tick, segment.moment, segment.first + jnp.arange(config.periods))


def before(config: OnlineConfig, world: str, agent: str, path: str, seed: int, key, references) -> Segment:
    clock: Any = np.float32(np.random.default_rng(seed).uniform(0, random_flight.CLOCK))
    controller, hardware, field = config.controller(world), config.hardware(world), agents.nominal(world)
    period, truth = controller.period, truth_of(world, NOTHING, clock)
    if agent == "online":
        estimator = agents.online(world, hardware, period)
    elif agent == "l1":
        estimator = agents.L1(field, 5.0, np.asarray(config.l1_cutoff, np.float32), period)
    else:
        known = Equations(truth) if agent == "oracle" else field
        estimator = agents.fixed_model(known, period, clock, config.bandwidth if agent == "observer" else 0.0)
    index, loop = list(PATHS).index(path), Loop(controller, hardware, estimator)
    start = loop.begin(jnp.asarray(references[index, 0]), controller.begin(), key)
    return agents.as_numpy(Segment(estimator, start, truth, np.asarray(index, np.int32), np.asarray(0, np.int32)))


def after(config: OnlineConfig, trial: Trial, first: Segment, moment: Any, fitted: Mapping[str, Any]) -> Segment:
    """Return the segment after the change, with another vehicle and possibly an estimator with prior knowledge."""
    estimator, period, (world, agent, change, _, seed) = first.estimator, DT, trial
    clock = np.random.default_rng(seed).uniform(0, random_flight.CLOCK)
    truth = truth_of(world, change, clock)
    if agent == "oracle" and is_rotorpy(world):
        estimator = agents.fixed_model(Equations(truth), period, clock)
    elif agent == "oracle":
        field = agents.as_numpy(agents.with_theta(world, agents.true_theta(world, change)))
        estimator = agents.fixed_model(field, period, clock, share=float(wind in domain_of(change).forces))
    if agent == "least_squares":
        estimator = agents.fixed_model(lane(fitted[change], seed), period, clock)
    return Segment(estimator, moment, truth, first.path, np.asarray(config.periods, np.int32))


def ground_fits(config: OnlineConfig, world: str, change: str) -> AbstractVectorField:
    """Fit `nominal` with a disturbance to ten seconds of random flight after a change, stacked over seeds."""
    states, inputs = ground_flights(world, change, config.seeds, jax.random.key(sum(map(ord, change))))
    noisy = jax.vmap(jax.vmap(config.hardware(world).measure))(
        jnp.asarray(states, jnp.float32), jax.random.split(jax.random.key(1), states.shape[:2])
    )
    field = with_disturbance(agents.nominal(world))

    @eqx.filter_jit
    def fit(windows: Trajectories):
        return fit_least_squares(field, windows).field

    found = [
        fit(windows_of(np.asarray(x), np.asarray(u, np.float32), DT, steps=WINDOW))
        for x, u in zip(noisy, inputs, strict=True)
    ]
    return stack([agents.as_numpy(each) for each in found])


def fly_all(config: OnlineConfig, name: str, stages: Stages) -> Run:
    """Fly all agents in a world."""
    references = sampled(config.controller(name), 2 * config.seconds + 1)
    fitted: dict[str, Any] = {}
    if "least_squares" in config.agents:
        jobs = [partial(ground_fits, config, name, change) for change in config.changes]
        fitted = dict(zip(config.changes, stages.parts(f"least squares {name}", jobs), strict=True))
    places = list(product(config.references, range(config.seeds)))
    # As plain arrays, of which segments are stacked.
    keys = dict(zip(places, jax.random.key_data(jax.random.split(jax.random.key(0), len(places))), strict=True))
    trials: dict[str, list[Trial]] = {}
    for agent, change, place in product(config.agents, config.changes, places):
        trial = Trial(name, agent, change, *place)
        trials.setdefault(trial.kind, []).append(trial)
    firsts = {
        kind: {start: before(config, name, *start, keys[start[1:]], references) for start in {t.start: 0 for t in each}}
        for kind, each in trials.items()
    }
    kinds = {kind: list(each.values()) for kind, each in firsts.items()}
    most = {kind: len(each) for kind, each in trials.items()}
    compiled = partial(programs.compiled, partial(simulate, config, name), kinds, most, (references,))
    made = stages.timed(f"compiling {name}", compiled, f"{len(kinds)} programs")

    def fly(kind: str) -> Record:
        """Return the trials' records after the change."""
        moments, _ = programs.fly(made[kind], kinds[kind], (references,))
        numbers = {start: i for i, start in enumerate(firsts[kind])}
        segments = [
            after(config, trial, firsts[kind][trial.start], lane(moments, numbers[trial.start]), fitted)
            for trial in trials[kind]
        ]
        return programs.fly(made[kind], segments, (references,))[1]

    began, worked = time.perf_counter(), time.process_time()
    late = [
        stages.timed(f"flying {name} {kind}", partial(fly, kind), f"{len(each)} flights")
        for kind, each in trials.items()
    ]
    spent = time.perf_counter() - began, time.process_time() - worked
    together = Record(*(np.concatenate(leaves) for leaves in zip(*late, strict=True)))
    return Run([trial for each in trials.values() for trial in each], together, *spent)
