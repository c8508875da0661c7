"""Usual flights in each world, as the datasets of other experiments."""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray
from rich.console import Console

from experiments.paper import study
from experiments.paper.conditions import fresh_fields
from experiments.paper.config import Config, OneFlight
from experiments.reporting.names import HYBRID
from experiments.reporting.report import Report
from experiments.reporting.results import Results, Row
from experiments.runner.stages import Stages, stages_of
from experiments.worlds.iris import Iris, domain_of
from experiments.worlds.rotorpy import ROTORPY
from experiments.worlds.world import DT, NOTHING, USUAL, Flown, World, logged
from hybrid_jax.adaptation import LeastSquares
from hybrid_jax.dynamics import AbstractVectorField, Hybrid, rigid_body
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.networks.mlp import zero_output
from hybrid_jax.sim import gone_wrong
from hybrid_jax.sim.flight import SplitSpec
from hybrid_jax.training import Settings
from hybrid_jax.training.objective import scaled_loss
from hybrid_jax.trajectories import Trajectories

WORLDS: dict[str, World] = {world.name: world for world in (Iris(), *ROTORPY)}
LEARNING = 20.0  # s, of a flight
# Learned without a network.
PHYSICS = "Ix", "Iy", "Iz", "k", "drag", "aerodynamic_moment", "rate_damping", "translational_lift", "rotor_drag"
SPARE = 1.5  # times as many flights are flown as are needed


class Sources(NamedTuple):
    """A hybrid for each seed, stacked, and the usual flights that all were trained on."""

    fields: AbstractVectorField
    windows: Trajectories


def in_each_world(
    name: str,
    tags: Sequence[str],
    of_world: Callable[..., Sequence[Row]],
    report: Callable[..., Report],
    config: Any,
    console: Console,
) -> None:
    """Run an experiment: `of_world(world, config, stages)` returns the rows of one of its worlds."""
    stages = stages_of(config, console)
    rows = [row for world in config.worlds for row in of_world(WORLDS[world], config, stages)]
    stages.publish(name, config, Results(rows, tags), report)


def usual_flights(
    world: World, change: str, flights: int, seconds: float, key: PRNGKeyArray, kind: str = USUAL
) -> Flown:
    """Fly without a crash: the pilot of some vehicles turns over now and then."""
    flown = world.fly(change, kind, round(SPARE * flights), seconds, key)
    kept = np.flatnonzero(~gone_wrong(flown.states))[:flights]
    return Flown(*(part[kept] for part in flown))


def dataset(world: World, change: str, splits: dict[str, SplitSpec], config: Config, stages: Stages) -> Dataset:
    """Return usual flights of a world after a change, those of the Iris as in the paper's experiments."""
    if isinstance(world, Iris):
        return study.flown(domain_of(change), splits, config, stages)
    name = f"{world.name} {change}"

    def fly() -> Dataset:
        parts = {}
        for split, spec in splits.items():
            flights = spec.flights or -(-spec.windows * spec.steps // round(LEARNING / DT))
            seconds = -(-spec.windows // flights) * spec.steps * DT
            own = zlib.crc32(f"{name} {split}".encode())
            key = jax.random.fold_in(jax.random.key(config.data_seed), own)
            flown = usual_flights(world, change, flights, seconds, key)
            parts[split] = logged(flown, key, spec.steps, noise=0.0)[: spec.windows]
        described = {"domain": name, "splits": {split: asdict(spec) for split, spec in splits.items()}}
        return Dataset(parts, {"config": described})

    return study.received(name, fly, change == NOTHING, config, stages)


def sources(world: World, config: OneFlight, stages: Stages) -> Sources:
    source = dataset(world, NOTHING, study.source_splits(config), config, stages)
    return Sources(trained(world, config, stages, source), source.splits["train"])


def trained(world: World, config: OneFlight, stages: Stages, source: Dataset) -> AbstractVectorField:
    """Train a hybrid for each seed on the same flights; see `OneFlight.source_training`."""
    start, fresh = None, fresh_fields(HYBRID, world.vehicle, config)
    if config.source_training == "physics_first":
        windows, body = source.splits["train"], rigid_body(world.vehicle, PHYSICS)
        settings = Settings(objective=scaled_loss(body, windows))
        physics = LeastSquares(False).solve(body, windows, windows, settings).field
        physics = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (config.seeds, *leaf.shape)), physics)
        start = Hybrid(physics, zero_output(cast(Any, fresh).residual))
        config = replace(config, rates=replace(config.rates, physics=0.0))
    return study.pretrained(HYBRID, world.vehicle, config, stages, source, start).fields
