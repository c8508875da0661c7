"""Train and test in every fold."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from experiments.real_flight.folds import Fold, hold_out_validation, make_folds, require_windows
from experiments.real_flight.models import rigid_body_of, thrust_baseline
from experiments.real_flight.recipes import RECIPES, equivalent_recipe
from experiments.real_flight.rows import TAGS, least
from experiments.real_flight.scoring import (
    Test,
    linear_residuals,
    parameters,
    relative_error,
    score,
    score_model,
)
from experiments.real_flight.train import (
    Experiment,
    TrainedModel,
    TrainingData,
    adapt,
    refit,
    source_data,
    target_data,
    train_on_source,
    transfer,
)
from experiments.reporting.results import Results
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.baselines import HoldState
from hybrid_jax.dynamics.vehicle_file import VehicleModel
from hybrid_jax.flights.scores import flight_errors
from hybrid_jax.flights.windows import count_windows, cut_windows

CHOICE_SEEDS = 2  # seeds that are trained to choose a recipe
FROM_SCRATCH = ("hybrid",)  # models that are trained from scratch too, to show what the source is worth


@dataclass(frozen=True)
class Outputs:
    """What an experiment found.

    Attributes:
        rows: one per test; see `rows`.
        errors: of each row, by its tags: RMS and mean over windows of the error at every step, (2, 4, t).
        choices: of each fold, by recipe, the validation error over the baseline's; empty with a single recipe.
        trained: by number of the fold, model and mode.
    """

    folds: list[Fold]
    rows: list[dict[str, Any]] = field(default_factory=list)
    errors: dict[tuple[Any, ...], Float[np.ndarray, "2 4 t"]] = field(default_factory=dict)
    choices: dict[str, dict[str, float]] = field(default_factory=dict)
    trained: dict[tuple[int, str, str], TrainedModel] = field(default_factory=dict)

    @property
    def table(self) -> Results:
        """The table of results."""
        return Results(self.rows, TAGS)

    def add(self, tests: Iterable[Test]) -> None:
        """Add the rows and errors of some tests."""
        for row, errors in tests:
            self.rows.append(row)
            self.errors[tuple(row[tag] for tag in TAGS)] = errors

    def by_step(self, row: Mapping[str, Any]) -> Float[np.ndarray, "2 4 t"]:
        """The errors of a row at every step."""
        return self.errors[tuple(row[tag] for tag in TAGS)]


def run_folds(experiment: Experiment) -> Outputs:
    """Train and test all models in all folds; finished stages come from the cache."""
    config, logs = experiment.config, experiment.logs
    tested = logs["test"].logs if "test" in logs else None
    outputs = Outputs(make_folds(logs.get("target", logs["source"]).logs, tested, config))
    source = Fold("source", *hold_out_validation(logs["source"].logs, config), []) if "target" in logs else None
    require_windows(outputs.folds, source, config)
    if source:
        _run_with_target(experiment, source, outputs)
    else:
        _run_without_target(experiment, outputs)
    return outputs


def each_fold(folds: Sequence[Fold]) -> Iterator[tuple[int, Fold]]:
    """Iterate over the folds; compiled programs of the previous fold are freed.

    A program of a sweep takes hundreds of memory maps, and Linux gives a process 65 530.
    """
    for number, fold in enumerate(folds):
        jax.clear_caches()
        yield number, fold


def _run_without_target(experiment: Experiment, outputs: Outputs) -> None:
    """Train on the flights of each fold and test."""
    config, before = experiment.config, experiment.before
    for number, fold in each_fold(outputs.folds):
        name = f"fold {number}"

        def candidate(recipe: str, fold=fold, name=name) -> TrainedModel:
            data, seeds = source_data(experiment, fold, recipe), min(CHOICE_SEEDS, config.seeds)
            return train_on_source(experiment, f"choice {name}", "hybrid", recipe, data, seeds)

        chosen = _choose_recipe(experiment, outputs, fold, candidate)
        data, scoring = source_data(experiment, fold, chosen), _scoring(experiment, fold)
        outputs.add(_baselines(scoring, before))
        for model in config.models:
            recipe = equivalent_recipe(model, chosen, config.tried)
            trained = train_on_source(experiment, name, model, recipe, data, config.seeds)
            if config.refit:
                trained = refit(experiment, name, fold, data, trained)
            _add(outputs, number, scoring, trained, parameters(trained, data))
        outputs.add(_linear_of_source(scoring, before, before, data, "source_only"))


def _run_with_target(experiment: Experiment, source: Fold, outputs: Outputs) -> None:
    """Train on the source once per recipe, adapt in each fold and test."""
    config = experiment.config
    windows = {RECIPES[name].window for name in config.tried}
    capacity = max(count_windows(fold.train, steps) for fold in outputs.folds for steps in windows)
    sources = {name: source_data(experiment, source, name) for name in config.tried}
    trained: dict[tuple[str, str], TrainedModel] = {}
    for number, fold in each_fold(outputs.folds):
        name = f"fold {number}"

        def candidate(recipe: str, fold=fold, name=name) -> TrainedModel:
            data, seeds = sources[recipe], min(CHOICE_SEEDS, config.seeds)
            start = transfer(experiment, train_on_source(experiment, "choice source", "hybrid", recipe, data, seeds))
            here = target_data(experiment, fold, recipe, data.objective, capacity)
            return adapt(experiment, f"choice {name}", "fine_tuned", start, here, [max(config.n)])

        chosen = _choose_recipe(experiment, outputs, fold, candidate)
        data, scoring = sources[chosen], _scoring(experiment, fold)
        here = target_data(experiment, fold, chosen, data.objective, capacity)
        outputs.add(_baselines(scoring, experiment.after))
        for model in config.models:
            recipe = equivalent_recipe(model, chosen, config.tried)
            if (model, recipe) not in trained:
                trained[model, recipe] = train_on_source(experiment, "source", model, recipe, data, config.seeds)
            start = transfer(experiment, trained[model, recipe])
            _add(outputs, number, scoring, start, parameters(trained[model, recipe], data))
            for mode in ("fine_tuned", "scratch") if model in FROM_SCRATCH else ("fine_tuned",):
                adapted = adapt(experiment, name, mode, start, here, config.n)
                _add(outputs, number, scoring, adapted, parameters(adapted, here))
        outputs.add(_linear_of_source(scoring, experiment.before, experiment.after, data, "zero_shot"))
        outputs.add(_linear_of_target(scoring, experiment.after, here, adapted))


def _scoring(experiment: Experiment, fold: Fold) -> Callable[..., Test]:
    """Bind `score` to the test windows of a fold, one from every sample."""
    windows = cut_windows(fold.test, experiment.config.longest).windows
    return partial(score, windows=windows, config=experiment.config, fold=fold.name)


def _add(outputs: Outputs, number: int, scoring: Callable[..., Test], trained: TrainedModel, theta) -> None:
    outputs.add(score_model(scoring, trained, theta))
    outputs.trained[number, trained.model, trained.mode] = trained


def _choose_recipe(
    experiment: Experiment, outputs: Outputs, fold: Fold, candidate: Callable[[str], TrainedModel]
) -> str:
    """Choose the recipe whose hybrids do best on the fold's validation flights; of one recipe, take that."""
    config = experiment.config
    if len(config.tried) == 1:
        return config.tried[0]
    windows = cut_windows(fold.validation, config.longest).windows
    baseline = flight_errors(thrust_baseline(experiment.after), windows)

    def error(trained: TrainedModel) -> float:
        found = [flight_errors(trained.run(index), windows) for index in range(len(trained))]
        return float(np.mean([relative_error(errors, baseline, config.horizon) for errors in found]))

    outputs.choices[fold.name] = {name: error(candidate(name)) for name in config.tried}
    return least(outputs.choices[fold.name])


def _baselines(scoring: Callable[..., Test], model: VehicleModel) -> list[Test]:
    fields: Mapping[str, AbstractVectorField] = {"hold": HoldState(), "thrust": thrust_baseline(model)}
    return [scoring(field, model=name, mode="nominal") for name, field in fields.items()]


def _linear_of_source(
    scoring: Callable[..., Test], before: VehicleModel, after: VehicleModel, data: TrainingData, mode: str
) -> list[Test]:
    """Fit a linear residual of the rigid body to all source windows, and test it on the present vehicle."""
    windows = [np.arange(len(data.train))]
    (field,) = linear_residuals(rigid_body_of(before), data, windows, rigid_body_of(after))
    return [scoring(field, model="linear_residual", mode=mode)]


def _linear_of_target(
    scoring: Callable[..., Test], model: VehicleModel, data: TrainingData, adapted: TrainedModel
) -> list[Test]:
    """Fit a linear residual of the rigid body to the windows of each adapted run, and test it."""
    tests, body = [], rigid_body_of(model)
    for size in dict.fromkeys(map(len, adapted.subsets)):
        runs = [run for run, subset in enumerate(adapted.subsets) if len(subset) == size]
        fields = linear_residuals(body, data, [adapted.subsets[run] for run in runs], body)
        columns = {"model": "linear_residual", "mode": "scratch", "n_train": size}
        tests += [scoring(each, **columns, seed=adapted.seeds[i]) for i, each in zip(runs, fields, strict=True)]
    return tests
