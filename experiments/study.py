"""The course of both experiments: fly, pre-train, adapt, test; from a configuration to the rows of the report."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console

from experiments.conditions import adaptation, fresh_fields, pretraining, settings
from experiments.make_flights import chosen_flights, flights
from experiments.protocol import Config
from experiments.stages import Stages
from hybrid_jax.datasets import Dataset
from hybrid_jax.lanes import lane
from hybrid_jax.rows import Row, with_rho
from hybrid_jax.sim.domain import SOURCE, Domain
from hybrid_jax.sim.record import SplitSpec
from hybrid_jax.sweep import evaluate
from hybrid_jax.training import STATUS_NAMES, STOPPED, FitState
from hybrid_jax.vector_field import AbstractVectorField, Hybrid
from hybrid_jax.vehicle import Vehicle

EVERY = 10  # test flights are compared with the truth every 0.1 s
TESTED = ("source_only", "fine_tuned", "target_only")


@dataclass(frozen=True)
class Lanes:
    """The trained lanes of one model in one mode.

    Attributes:
        sizes, seeds: of each lane.
        final: stacked final states; `final.best` are the models.
        errors: L^T_MSE of each lane on the test flights.
    """

    model: str
    mode: str
    sizes: Sequence[int]
    seeds: Sequence[int]
    final: FitState
    errors: np.ndarray

    def field(self, index: int) -> AbstractVectorField:
        """The model of one lane."""
        return lane(self.final.best, index)


@dataclass(frozen=True)
class Study:
    """What an experiment found: the flights, every trained lane, the rows, seconds by stage."""

    source: Dataset
    target: Dataset
    lanes: list[Lanes]
    rows: list[Row]
    seconds: dict[str, float] = field(default_factory=dict)
    reused: list[str] = field(default_factory=list)


def study(domain: Domain, vehicle: Vehicle, config: Config, console: Console) -> Study:
    """Run the protocol on a target domain; finished stages come from the cache.

    Args:
        vehicle: what the engineer knows of the vehicle; its nominal θ_p is where the models start from.
    """
    stages = Stages(config.cache / "sweeps", console)

    def get(file: Path | None, of: Domain, splits: dict[str, SplitSpec]) -> Dataset:
        if file is not None:
            return chosen_flights(file, of, splits)
        return stages.timed(f"flights {of.name}", lambda: flights(of, splits, config.data_seed, config.cache))

    source = get(config.source_flights, SOURCE, source_splits(config))
    target = get(config.target_flights, domain, target_splits(config))
    lanes: list[Lanes] = []
    for model in config.models:
        lanes += _model_lanes(model, vehicle, config, stages, source, target)
    rows = with_rho([row for group in lanes for row in rows_of(group)])
    return Study(source, target, lanes, rows, stages.seconds, stages.reused)


def source_splits(config: Config) -> dict[str, SplitSpec]:
    """What is flown in the source."""
    return {"train": SplitSpec(config.source_train, 10), "validation": SplitSpec(config.validation, 10)}


def target_splits(config: Config) -> dict[str, SplitSpec]:
    """What is flown in the target; the train split is the pool from which every seed draws."""
    return {
        "train": SplitSpec(max(config.sizes), 10),
        "validation": SplitSpec(config.validation, 10),
        "test": SplitSpec(config.test, 100),
    }


def _model_lanes(
    model: str, vehicle: Vehicle, config: Config, stages: Stages, source: Dataset, target: Dataset
) -> list[Lanes]:
    shared = settings(config)
    pretrained = stages.run(f"pre-training {model}", *pretraining(model, vehicle, config), shared, source)
    starts = {"fine_tuned": pretrained.best, "target_only": fresh_fields(model, vehicle, config)}
    finals = {"source_only": pretrained} | {
        mode: stages.run(
            f"{mode} {model} {domain_name(target)}", *adaptation(model, mode, start, config), shared, target
        )
        for mode, start in starts.items()
    }
    return [_tested(model, mode, finals[mode], config, stages, target) for mode in TESTED]


def _tested(model: str, mode: str, final: FitState, config: Config, stages: Stages, target: Dataset) -> Lanes:
    sizes = (0,) if mode == "source_only" else config.sizes
    errors = stages.timed(
        f"test {mode} {model}", lambda: evaluate(final.best, target.splits["test"], EVERY, settings(config))
    )
    seeds = range(config.seeds)
    return Lanes(model, mode, [n for n in sizes for _ in seeds], [s for _ in sizes for s in seeds], final, errors)


def domain_name(dataset: Dataset) -> str:
    """Where a dataset was flown."""
    return str(dataset.config["domain"])


def rows_of(lanes: Lanes) -> list[Row]:
    """A row for each lane, ρ still open."""
    final = lanes.final
    return [
        Row(
            model=lanes.model,
            mode=lanes.mode,
            n_train=int(size),
            seed=int(seed),
            test_mse=float(lanes.errors[i]),
            rho=None,
            val_mse=float(final.best_mse[i]),
            epochs=int(final.epoch[i]),
            status=STATUS_NAMES.get(int(final.status[i]), STATUS_NAMES[STOPPED]),
            theta=theta_of(lanes.field(i)),
        )
        for i, (size, seed) in enumerate(zip(lanes.sizes, lanes.seeds, strict=True))
    ]


def theta_of(field: AbstractVectorField) -> dict[str, float] | None:
    """θ_p of a model that has physics."""
    physics = field.physics if isinstance(field, Hybrid) else field
    theta = getattr(physics, "theta", None)
    return None if theta is None else {name: float(value) for name, value in theta().items()}
