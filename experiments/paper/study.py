"""The protocol of both experiments: fly, pre-train, adapt, test; from a configuration to the rows of the report."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from experiments.make_flights import chosen_flights, flights
from experiments.paper.conditions import adaptation, annealing, fresh_fields, pretraining, settings
from experiments.paper.config import AdaptationConfig, Config
from experiments.paper.lanes import Lanes, rows_of, solution, source_of, trained, with_rho
from experiments.paper.sensors import measured
from experiments.paper.solved import SOLVED, Solved, solved
from experiments.reporting.names import FINE_TUNED, SOURCE_ONLY, TARGET_ONLY
from experiments.reporting.results import Results
from experiments.runner.precompile import PrecompilePool, placeholder
from experiments.runner.stages import Stages, stages_of
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.io.archive import Arrays
from hybrid_jax.io.datasets import ARRAYS, Dataset
from hybrid_jax.sim.domain import SOURCE, Domain
from hybrid_jax.sim.flight import SplitSpec
from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.training import evaluate, sweep
from hybrid_jax.training.fitting import STOPPED, FitState
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import Vehicle

EVERY = 10  # test flights are compared with the truth every 0.1 s


@dataclass(frozen=True)
class Study:
    """The outcome of an experiment: flights, trained models, rows, seconds by stage, and notes on these."""

    source: Dataset
    target: Dataset
    lanes: list[Lanes]
    rows: Results
    seconds: dict[str, float]
    notes: list[str]


def study(domain: Domain, vehicle: Vehicle, config: AdaptationConfig, console: Console) -> Study:
    """Run the protocol on a target domain, from models around the nominal θ_p of the vehicle before the change."""
    stages = stages_of(config, console)
    lanes: list[Lanes] = []
    learned: dict[str, FitState] = {}
    sources = dict.fromkeys(source_of(model) for model in config.models)
    unseen = [model for model in sources if not stages.knows(f"pre-training {model}")]
    with PrecompilePool({model: partial(_compile, model, vehicle, config) for model in unseen}) as programs:
        source = flown(SOURCE, source_splits(config), config, stages, config.source_flights)
        target = flown(domain, target_splits(config), config, stages, config.target_flights)
        for model in config.models:
            start = source_of(model)
            if start not in learned:
                programs.wait_for(start)
                learned[start] = pretrained(start, vehicle, config, stages, source)
                lanes.append(tested(start, SOURCE_ONLY, learned[start], config, stages, target))
            fields, finals = learned[start].best, dict[str, FitState | Solved]()
            if model in SOLVED:
                name = f"{FINE_TUNED} {model} {domain_name(target)}"
                finals[FINE_TUNED] = solved(name, SOLVED[model], fields, config, stages, target)
            else:
                finals[FINE_TUNED] = adapted(model, FINE_TUNED, fields, config, stages, target)
                fresh = fresh_fields(model, vehicle, config)
                finals[TARGET_ONLY] = adapted(model, TARGET_ONLY, fresh, config, stages, target)
            lanes += [tested(model, mode, final, config, stages, target) for mode, final in finals.items()]
    rows = with_rho(rows_of(lanes, domain_name(target)))
    return Study(source, target, lanes, rows, stages.seconds, stages.notes())


def pretrained(model: str, vehicle: Vehicle, config: Config, stages: Stages, source: Dataset) -> FitState:
    """A model after pre-training on source flight, one run per seed."""
    shared = settings(config), source, capacity(config)
    found = stages.run(f"pre-training {model}", *pretraining(model, vehicle, config), *shared)
    for factor in config.rates.decay:
        lanes = annealing(model, found.best, factor, config)
        found = stages.run(f"pre-training {model}, rates times {factor:g}", *lanes, *shared)
    return found


def adapted(
    model: str, mode: str, fields: AbstractVectorField, config: Config, stages: Stages, target: Dataset
) -> FitState:
    """A model after training on target flight, one run for each size and seed; see `places`."""
    lanes = adaptation(model, mode, fields, config)
    return stages.run(f"{mode} {model} {domain_name(target)}", *lanes, settings(config), target, capacity(config))


def tested(model: str, mode: str, found: FitState | Solved, config: Config, stages: Stages, target: Dataset) -> Lanes:
    """The models with their L^T_MSE on the test flights."""
    fields = found.fields if isinstance(found, Solved) else found.best
    windows, count = target.splits["test"], capacity(config)[0]
    errors = stages.timed(f"test {mode} {model}", lambda: evaluate(fields, windows, EVERY, settings(config), count))
    where = places((0,) if mode == SOURCE_ONLY else config.sizes, config)
    if isinstance(found, Solved):
        return solution(model, *where, found, errors)
    return trained(model, mode, *where, found, errors)


def flown(
    domain: Domain, splits: dict[str, SplitSpec], config: Config, stages: Stages, file: Path | None = None
) -> Dataset:
    """The flights of a domain with the configured measurement noise: of a file, or from the cache or the simulator."""

    def read() -> Dataset:
        if file is not None:
            return chosen_flights(file, domain, splits)
        return flights(domain, splits, config.data_seed, config.cache)

    found = stages.timed(f"flights {domain.name}", lambda: from_first(read))
    return measured(found, config.noise, config.data_seed)


def from_first(read: Callable[[], Dataset]) -> Dataset:
    """The dataset that `read` returns on process 0; the others receive the same bits and need no file."""

    def parts() -> tuple[Any, Arrays]:
        found = read()
        arrays = {f"{name}/{part}": getattr(found.splits[name], part) for name in found.splits for part in ARRAYS}
        steps = {name: windows.dt for name, windows in found.splits.items()}
        return [dict(found.metadata), steps, found.origin], arrays

    (metadata, steps, origin), arrays = hosts.from_first(parts)
    splits = {name: Trajectories(*(arrays[f"{name}/{part}"] for part in ARRAYS), dt=dt) for name, dt in steps.items()}
    return Dataset(splits, metadata, origin)


def source_splits(config: Config) -> dict[str, SplitSpec]:
    """The splits of the source."""
    return {"train": SplitSpec(config.source_train, 10), "validation": SplitSpec(config.validation, 10)}


def target_splits(config: Config) -> dict[str, SplitSpec]:
    """The splits of the target; every seed draws from the train split."""
    return adaptation_splits(config) | {"test": SplitSpec(config.test, 100)}


def adaptation_splits(config: Config) -> dict[str, SplitSpec]:
    """The splits of the target for adaptation."""
    return {"train": SplitSpec(config.pooled(), 10), "validation": SplitSpec(config.validation, 10)}


def capacity(config: Config) -> tuple[int, int]:
    """Runs and windows to compile for, shared by pre-training (fewer runs) and adaptation (fewer windows)."""
    return config.seeds * len(config.sizes), max(config.source_train, config.pooled())


def _compile(model: str, vehicle: Vehicle, config: Config) -> None:
    """Compile all programs that training and testing a model will run; they depend on shapes only."""
    shared, fresh = settings(config), fresh_fields(model, vehicle, config)
    source, target = (
        {name: placeholder(spec) for name, spec in splits(config).items()} for splits in (source_splits, target_splits)
    )
    before = pretraining(model, vehicle, config)
    after = adaptation(model, TARGET_ONLY, fresh, config)
    for (states, plans), windows in ((before, source), (after, target)):
        stopped = replace(states, status=np.full_like(states.status, STOPPED))
        sweep(stopped, plans, windows["train"], windows["validation"], shared, min_capacity=capacity(config))
    evaluate(before[0].best, target["test"], EVERY, shared, capacity(config)[0])


def places(sizes: Sequence[int], config: Config) -> tuple[list[int], list[int]]:
    """The size and the seed of each run, in the order of `conditions`."""
    return [n for n in sizes for _ in range(config.seeds)], [*range(config.seeds)] * len(sizes)


def domain_name(dataset: Dataset) -> str:
    """The domain of a dataset."""
    return str(dataset.config["domain"])
