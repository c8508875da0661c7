"""The protocol of both experiments: fly, pre-train, adapt, test; from a configuration to the rows of the report."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
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
from experiments.paper.solved import SOLVED, solved
from experiments.reporting.names import FINE_TUNED, SOURCE_ONLY, TARGET_ONLY
from experiments.reporting.results import Results
from experiments.runner.precompile import PrecompilePool, placeholder
from experiments.runner.stages import Stages, stages_of
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.io.archive import Arrays
from hybrid_jax.io.datasets import ARRAYS, Dataset
from hybrid_jax.sim.domain import SOURCE, Domain
from hybrid_jax.sim.record import SplitSpec
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
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def study(domain: Domain, vehicle: Vehicle, config: AdaptationConfig, console: Console) -> Study:
    """Run the protocol on a target domain; finished stages come from the cache.

    Args:
        vehicle: as known before the change; models start around its nominal θ_p.
    """
    stages = stages_of(config, console)

    def get(file: Path | None, of: Domain, splits: dict[str, SplitSpec]) -> Dataset:
        if file is not None:
            return measured(from_first(lambda: chosen_flights(file, of, splits)), config.noise, config.data_seed)
        return flown(of, splits, config, stages)

    lanes: list[Lanes] = []
    learned: dict[str, FitState] = {}
    sources = dict.fromkeys(source_of(model) for model in config.models)
    unseen = [model for model in sources if not stages.knows(f"pre-training {model}")]
    with PrecompilePool({model: partial(_compile, model, vehicle, config) for model in unseen}) as programs:
        source = get(config.source_flights, SOURCE, source_splits(config))
        target = get(config.target_flights, domain, target_splits(config))
        for model in config.models:
            start = source_of(model)
            if start not in learned:
                programs.wait_for(start)
                learned[start] = pretrained(start, vehicle, config, stages, source)
                lanes.append(_tested(start, SOURCE_ONLY, learned[start], config, stages, target))
            lanes += _adapted_lanes(model, learned[start].best, vehicle, config, stages, target)
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


def flown(domain: Domain, splits: dict[str, SplitSpec], config: Config, stages: Stages) -> Dataset:
    """The flights of a domain, from the cache or the simulator, with the configured measurement noise."""
    found = stages.timed(
        f"flights {domain.name}",
        lambda: from_first(lambda: flights(domain, splits, config.data_seed, config.cache)),
    )
    return measured(found, config.noise, config.data_seed)


def from_first(read: Callable[[], Dataset]) -> Dataset:
    """The dataset that `read` returns on process 0; the others receive the same bits and need no file."""

    def parts() -> tuple[Any, Arrays]:
        found = read()
        arrays = {f"{name}/{part}": getattr(found.splits[name], part) for name in found.splits for part in ARRAYS}
        return [
            dict(found.metadata),
            {name: windows.dt for name, windows in found.splits.items()},
            found.origin,
        ], arrays

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


def _adapted_lanes(
    model: str, source: AbstractVectorField, vehicle: Vehicle, config: Config, stages: Stages, target: Dataset
) -> list[Lanes]:
    """A model after adaptation to the target: fine-tuned and target-only, or solved."""
    if model in SOLVED:
        return [_solved(model, source, config, stages, target)]
    starts = {FINE_TUNED: source, TARGET_ONLY: fresh_fields(model, vehicle, config)}
    finals = {mode: adapted(model, mode, start, config, stages, target) for mode, start in starts.items()}
    return [_tested(model, mode, final, config, stages, target) for mode, final in finals.items()]


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


def _tested(model: str, mode: str, final: FitState, config: Config, stages: Stages, target: Dataset) -> Lanes:
    errors = _errors(f"test {mode} {model}", final.best, config, stages, target)
    return trained(model, mode, *places((0,) if mode == SOURCE_ONLY else config.sizes, config), final, errors)


def _solved(model: str, source: AbstractVectorField, config: Config, stages: Stages, target: Dataset) -> Lanes:
    name = f"{FINE_TUNED} {model}"
    found = solved(f"{name} {domain_name(target)}", SOLVED[model], source, config, stages, target)
    errors = _errors(f"test {name}", found.fields, config, stages, target)
    return solution(model, *places(config.sizes, config), found, errors)


def _errors(stage: str, fields: AbstractVectorField, config: Config, stages: Stages, target: Dataset) -> np.ndarray:
    """L^T_MSE of stacked fields on the test flights."""
    return stages.timed(
        stage, lambda: evaluate(fields, target.splits["test"], EVERY, settings(config), capacity(config)[0])
    )


def places(sizes: Sequence[int], config: Config) -> tuple[list[int], list[int]]:
    """The size and the seed of each run, in the order of `conditions`."""
    return [n for n in sizes for _ in range(config.seeds)], [*range(config.seeds)] * len(sizes)


def domain_name(dataset: Dataset) -> str:
    """The domain of a dataset."""
    return str(dataset.config["domain"])
