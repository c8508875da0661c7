"""The protocol of both experiments: fly, pre-train, adapt, test; from a configuration to the rows of the report."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.make_flights import chosen_flights, flights
from experiments.paper.conditions import adaptation, fresh_fields, held_back, measured, pretraining, settings, subsets
from experiments.paper.config import AdaptationConfig, Config
from experiments.paper.lanes import Fit, Lanes, by_altitude, fit_of, lanes_of, rows_of, source_of
from experiments.reporting import names
from experiments.reporting.names import FINE_TUNED, SOURCE_ONLY, TARGET_ONLY
from experiments.reporting.results import Results
from experiments.runner.stages import Stage, Stages
from hybrid_jax.adaptation import METHODS, LeastSquares, Method
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.io.datasets import ARRAYS, Dataset
from hybrid_jax.io.files import Arrays
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.runtime import FAST_COMPILE, jit_with
from hybrid_jax.sim.domain import SOURCE, Domain
from hybrid_jax.sim.flight import DT, SplitSpec
from hybrid_jax.status import Status
from hybrid_jax.sweep import hosts, lane
from hybrid_jax.sweep.training import evaluate, evaluate_windows, sweep
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import INPUT_SIZE, QUATERNION, STATE_SIZE, Vehicle

EVERY = 10  # test flights are compared with the truth every 0.1 s
# The models that are not trained: a method of the library adapts the hybrid.
SOLVED: Mapping[str, Method] = {
    names.LAST_LAYER: METHODS["last_layer"],
    names.LEAST_SQUARES: METHODS["theta_least_squares"],
    names.CONSTANT_DISTURBANCE: LeastSquares(disturbance=True),
    names.LINEAR_RESIDUAL: METHODS["linear_residual"],
}


@dataclass(frozen=True)
class Study:
    """The outcome of an experiment: flights, trained models and rows."""

    source: Dataset
    target: Dataset
    lanes: list[Lanes]
    rows: Results


def study(domain: Domain, vehicle: Vehicle, config: AdaptationConfig, stages: Stages) -> Study:
    """Run the protocol on a target domain, from models around the nominal θ_p of the vehicle before the change."""
    source, target, *models = protocol(domain, vehicle, config, stages)
    results = stages.run([source, target, *models])
    lanes = [result for result in results.values() if isinstance(result, Lanes)]
    return Study(results[source], results[target], lanes, rows_of(lanes))


def protocol(domain: Domain, vehicle: Vehicle, config: AdaptationConfig, stages: Stages) -> list[Stage]:
    """Fly in the source and in the target; pre-train each model, adapt it to the target, and test it."""
    flying = partial(flown, config=config, stages=stages)
    source = Stage(("flights", SOURCE.name), partial(flying, SOURCE, source_splits(config), file=config.source_flights))
    target = Stage(("flights", domain.name), partial(flying, domain, target_splits(config), file=config.target_flights))
    home = Stage(("flights", "test"), partial(flying, SOURCE, {"test": SplitSpec(config.n_test, 100)}))
    found, learned = [source, target, home], dict[str, Stage]()

    def test(model: str, mode: str, fit: Stage, *more: Stage) -> Stage:
        return Stage(("test", mode, model), partial(assess, model, mode, config, stages), (fit, target, *more))

    for model in config.models:
        start = source_of(model)
        if start not in learned:
            ahead = partial(_compile, start, vehicle, config)
            train = partial(pretrained, start, vehicle, config, stages)
            learned[start] = Stage(("pre-training", start), train, (source,), ahead)
            found += [learned[start], test(start, SOURCE_ONLY, learned[start], home)]
        both = config.target_only and model not in SOLVED
        for mode in (FINE_TUNED, TARGET_ONLY) if both else (FINE_TUNED,):
            ahead = partial(_compile_solved, model, vehicle, config) if model in SOLVED else None
            adapting = partial(_adapted, model, mode, vehicle, config, stages)
            adapt = Stage((mode, model, domain.name), adapting, (learned[start], target), ahead)
            found += [adapt, test(model, mode, adapt)]
    return found


def _adapted(
    model: str, mode: str, vehicle: Vehicle, config: Config, stages: Stages, learned: Fit, target: Dataset
) -> Fit:
    """Adapt a model from its source model or, target-only, from a fresh start."""
    if model in SOLVED:
        name = f"{mode} {model} {target.config['domain']}"
        return solved(name, SOLVED[model], learned.fields, config, stages, target)
    start = learned.fields if mode == FINE_TUNED else fresh_fields(model, vehicle, config)
    return adapted(model, mode, start, config, stages, target)


def pretrained(model: str, vehicle: Vehicle, config: Config, stages: Stages, source: Dataset, start: Any = None) -> Fit:
    """Train a model on source flight, from fresh fields or from others, stacked."""
    shared, name = (settings(config), source, capacity(config)), f"pre-training {model}"
    start = fresh_fields(model, vehicle, config) if start is None else start
    found = stages.sweep(name, *pretraining(model, start, config), *shared)
    for factor in config.rates.decay:
        lanes = pretraining(model, found.best, config, factor)
        found = stages.sweep(f"{name}, rates times {factor:g}", *lanes, *shared)
    return fit_of(found)


def adapted(
    model: str, mode: str, fields: AbstractVectorField, config: Config, stages: Stages, target: Dataset, name: str = ""
) -> Fit:
    """Train a model on target flight, one run for each size, draw and seed, in this order."""
    name = f"{mode} {name or model} {target.config['domain']}"
    if config.validation != "own":
        lanes = adaptation(model, mode, fields, config, config.sizes)
        return fit_of(stages.sweep(name, *lanes, settings(config), target, capacity(config)))
    # The windows to stop by are of the pool. Runs of one sweep have equally many, so each size is a sweep.
    data = Dataset(dict.fromkeys(("train", "validation"), target.splits["train"]), target.metadata)

    def of_size(size: int) -> Fit:
        lanes, shared = adaptation(model, mode, fields, config, [size]), settings(config)
        shared = replace(shared, batch_size=min(shared.batch_size, int(lanes[1].n_train[0])))
        return fit_of(stages.sweep(f"{name} {size}", *lanes, shared, data))

    return jax.tree.map(lambda *parts: np.concatenate(parts), *map(of_size, config.sizes))


def solved(
    name: str, method: Method, fields: AbstractVectorField, config: Config, stages: Stages, target: Dataset
) -> Fit:
    """Adapt each seed's field to its target windows by a method, for each size, as the stage `name`."""

    def of_size(size: int) -> Fit:
        return jax.device_get(_solved(*solving(method, fields, size, config), target.splits))

    parts = stages.parts(name, [partial(of_size, size) for size in config.sizes])
    return jax.tree.map(lambda *parts: np.concatenate(parts), *parts)


def solving(method: Method, fields: AbstractVectorField, size: int, config: Config) -> tuple[Method, Settings, Any]:
    starts = lane(fields, np.tile(np.arange(config.seeds), config.draws))
    return method, settings(config), (starts, *windows_of(method, size, config))


# A LaneMap would use all devices, but lineax does not compile under its shard_map, and this does not take long.
@jit_with(FAST_COMPILE)
def _solved(method: Method, shared: Settings, lanes: Any, splits: Mapping[str, Trajectories]) -> Fit:
    def one(run) -> Fit:
        field, subset, own = run
        pool = splits["train"]
        validation = splits["validation"] if own is None else pool[own]
        field, steps, status, _ = method.solve(field, pool[subset], validation, shared)
        val_mse = rollout_mse(field, validation, solver=shared.solver)
        return Fit(field, val_mse, jnp.asarray(steps), jnp.asarray(status))

    return jax.lax.map(one, lanes)


def windows_of(method: Method, size: int, config: Config) -> tuple[np.ndarray, np.ndarray | None]:
    """Return each run's windows to fit, in time order, and its validation windows among them, or None."""
    subset = subsets(config)[:, :size]
    subset = np.sort(subset) if config.draw == "contiguous" else subset
    if config.validation != "own":
        return subset, None
    return held_back(subset) if getattr(method, "uses_validation", True) else (subset, subset)


def assess(
    model: str, mode: str, config: Config, stages: Stages, fit: Fit, target: Dataset, home: Dataset | None = None
) -> Lanes:
    """Return the models with their L^T_MSE on the test flights, also by altitude; and on the source's, their floor."""
    errors, more = np.empty(0), {}
    for column, flown_in in {"source_mse": home, "test_mse": target}.items():
        if flown_in is not None:
            given = fit.fields, flown_in.splits["test"], EVERY, settings(config), capacity(config)[0]
            errors, each = stages.timed(
                f"test {mode} {model}", partial(evaluate_windows, *given), "compiling and testing"
            )
            more |= {column: errors, **by_altitude(column, given[1], each)}
    sizes = (0,) if mode == SOURCE_ONLY else config.sizes
    return lanes_of(target.config["domain"], model, mode, sizes, config.seeds, fit, errors, more=more)


def flown(
    domain: Domain, splits: dict[str, SplitSpec], config: Config, stages: Stages, file: Path | None = None
) -> Dataset:
    """Return a domain's flights with measurement noise from a file, which other processes need not have, the cache or
    the simulator.
    """

    def read() -> Dataset:
        if file is not None:
            return chosen_flights(file, domain, splits)
        return flights(domain, splits, config.data_seed, config.cache)

    return received(domain.name, read, domain is SOURCE, config, stages)


def received(name: str, read: Callable[[], Dataset], source: bool, config: Config, stages: Stages) -> Dataset:
    """Return the flights that process 0 reads or flies, with measurement noise; the others receive the same bits."""

    def first() -> tuple[Any, Arrays]:
        found = read()
        arrays = {f"{name}/{part}": getattr(found.splits[name], part) for name in found.splits for part in ARRAYS}
        steps = {name: windows.dt for name, windows in found.splits.items()}
        return [dict(found.metadata), steps], arrays

    (metadata, steps), arrays = stages.timed(f"flights {name}", lambda: hosts.from_first(first))
    splits = {n: Trajectories(*(arrays[f"{n}/{part}"] for part in ARRAYS), dt=dt) for n, dt in steps.items()}
    noise = config.noise if config.noise_on == "all" or not source else 0.0
    return measured(Dataset(splits, metadata), noise, config.data_seed)


def source_splits(config: Config) -> dict[str, SplitSpec]:
    return {"train": SplitSpec(config.source_train, 10), "validation": SplitSpec(config.validating(), 10)}


def target_splits(config: Config) -> dict[str, SplitSpec]:
    return drawn_splits(config) | {"test": SplitSpec(config.n_test, 100)}


def drawn_splits(config: Config) -> dict[str, SplitSpec]:
    """Return the pool and, if needed, separate trajectories for early stopping."""
    flights = config.draws * config.flown_each() if config.draw == "contiguous" else 0
    others = {} if config.validation == "own" else {"validation": SplitSpec(config.validation, 10)}
    return {"train": SplitSpec(config.pooled(), 10, flights), **others}


def capacity(config: Config) -> tuple[int, int]:
    """Runs and windows to compile for, shared by pre-training (fewer runs) and adaptation (fewer windows)."""
    return config.runs() * len(config.sizes), max(config.source_train, config.pooled())


def _compile(model: str, vehicle: Vehicle, config: Config) -> None:
    """Compile all programs for training and testing a model; they depend only on shapes."""
    shared, fresh = settings(config), fresh_fields(model, vehicle, config)
    source, target = (
        {name: placeholder(spec) for name, spec in splits(config).items()} for splits in (source_splits, target_splits)
    )
    before = pretraining(model, fresh, config)
    jobs = [(before, source)]
    if config.validation != "own":
        jobs.append((adaptation(model, TARGET_ONLY, fresh, config, config.sizes), target))
    for (states, plans), windows in jobs:
        stopped = replace(states, status=np.full_like(states.status, Status.OK))
        sweep(stopped, plans, windows["train"], windows["validation"], shared, min_capacity=capacity(config))
    evaluate(before[0].best, target["test"], EVERY, shared, capacity(config)[0])


def _compile_solved(model: str, vehicle: Vehicle, config: Config) -> None:
    fields = pretraining(source_of(model), fresh_fields(source_of(model), vehicle, config), config)[0].best
    target = {name: placeholder(spec) for name, spec in target_splits(config).items()}
    for size in config.sizes:
        lowered = _solved.lower(*solving(SOLVED[model], fields, size, config), target)  # pyright: ignore
        lowered.compile()


def placeholder(spec: SplitSpec) -> Trajectories:
    """Return windows at rest with the shapes of a split that is not yet simulated."""
    x = np.zeros((spec.windows, spec.steps, STATE_SIZE), np.float32)
    x[..., QUATERNION] = [1, 0, 0, 0]
    return Trajectories(x[:, 0], np.zeros((*x.shape[:2], INPUT_SIZE), np.float32), x, dt=DT)
