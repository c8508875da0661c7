"""Train and test in every fold."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import groupby
from typing import Any

import jax
import numpy as np

from experiments.real_flight import scoring, train
from experiments.real_flight.logs import Fold, hold_out_validation, make_folds, require_windows
from experiments.real_flight.models import RECIPES, equivalent_recipe, thrust_baseline
from experiments.real_flight.scoring import TAGS, Test, least, linear_residuals, parameters, relative_error
from experiments.real_flight.train import Experiment, TrainedModel, TrainingData
from experiments.reporting.results import Results
from hybrid_jax.dynamics.baselines import HoldState
from hybrid_jax.dynamics.multirotor import multirotor
from hybrid_jax.flights.scores import flight_errors
from hybrid_jax.flights.windows import count_windows, cut_windows

CHOICE_SEEDS = 2  # seeds that are trained to choose a recipe

Source = tuple[Callable[[str], TrainingData], Callable[..., TrainedModel]]


@dataclass(frozen=True)
class Outputs:
    folds: list[Fold]
    tests: list[Test] = field(default_factory=list)
    # Of each fold, by recipe, the validation error over the baseline's; empty with a single recipe.
    choices: dict[str, dict[str, float]] = field(default_factory=dict)
    trained: dict[tuple[int, str, str], TrainedModel] = field(default_factory=dict)  # by number of fold, model, mode

    @property
    def table(self) -> Results:
        return Results([row for row, _ in self.tests], TAGS)


def run_folds(experiment: Experiment) -> Outputs:
    """Train and test all models in all folds; finished stages come from the cache."""
    config, logs = experiment.config, experiment.logs
    tested = logs["test"].logs if "test" in logs else None
    outputs = Outputs(make_folds(logs.get("target", logs["source"]).logs, tested, config))
    source = Fold("source", *hold_out_validation(logs["source"].logs, config), []) if "target" in logs else None
    require_windows(outputs.folds, source, config)
    # With a target, all folds share the models of the source; else each fold has its own.
    shared = source_of(experiment, "source", source) if source else None
    for number, fold in enumerate(outputs.folds):
        jax.clear_caches()  # a program of a sweep takes hundreds of memory maps, and Linux gives a process 65 530
        _run_fold(experiment, outputs, number, shared or source_of(experiment, f"fold {number}", fold))
    return outputs


def source_of(experiment: Experiment, name: str, fold: Fold) -> Source:
    """Data of the flights before the change, by recipe, and models trained on them; each is made once."""
    data = cache(partial(train.training_data, experiment, fold))

    @cache
    def trained(model: str, recipe: str, seeds: int, prefix: str = "") -> TrainedModel:
        return train.train_on_source(experiment, f"{prefix}{name}", model, recipe, data(recipe), seeds)

    return data, trained


def _run_fold(experiment: Experiment, outputs: Outputs, number: int, source: Source) -> None:
    """Choose a recipe, train every model, adapt it if there is a target, and test."""
    config, fold, name = experiment.config, outputs.folds[number], f"fold {number}"
    adapts, (source_data, source_model) = "target" in experiment.logs, source
    windows = {RECIPES[recipe].window for recipe in config.tried}
    capacity = max(count_windows(each.train, steps) for each in outputs.folds for steps in windows)

    @cache
    def target(recipe: str) -> TrainingData:
        return train.training_data(experiment, fold, recipe, source_data(recipe), capacity)

    def candidate(recipe: str) -> TrainedModel:
        found = source_model("hybrid", recipe, min(CHOICE_SEEDS, config.seeds), "choice ")
        if not adapts:
            return found
        start = train.transfer(experiment, found)
        return train.adapt(experiment, f"choice {name}", "fine_tuned", start, target(recipe), [max(config.n)])

    chosen = _choose_recipe(experiment, outputs, fold, candidate)
    data, test = source_data(chosen), cut_windows(fold.test, config.longest).windows
    score = partial(scoring.score, windows=test, config=config, fold=fold.name)

    def add(trained: TrainedModel, theta: list[dict[str, Any]]) -> None:
        outputs.tests.extend(scoring.score_model(score, trained, theta))
        outputs.trained[number, trained.model, trained.mode] = trained

    baselines = {"hold": HoldState(), "thrust": thrust_baseline(experiment.after if adapts else experiment.before)}
    outputs.tests.extend(score(baseline, model=model, mode="nominal") for model, baseline in baselines.items())
    adapted: TrainedModel | None = None
    for model in config.models:
        first = source_model(model, equivalent_recipe(model, chosen, config.tried), config.seeds)
        if not adapts:
            first = train.refit(experiment, name, fold, data, first) if config.refit else first
            add(first, parameters(first, data))
            continue
        start = train.transfer(experiment, first)
        add(start, parameters(first, data))
        for mode in ("fine_tuned", "scratch") if model == "hybrid" else ("fine_tuned",):  # what the source is worth
            adapted = train.adapt(experiment, name, mode, start, target(chosen), config.n)
            add(adapted, parameters(adapted, target(chosen)))
    outputs.tests.extend(_linear_baselines(experiment, score, data, (adapted, target(chosen)) if adapted else None))


def _linear_baselines(experiment: Experiment, score: Callable[..., Test], source: TrainingData, target: Any):
    """Test linear residuals of the rigid body, fitted to all source windows and to those of each run on the target."""
    before, after = (multirotor(each.vehicle, (), each.terms) for each in (experiment.before, experiment.after))
    now, mode = (after, "zero_shot") if target else (before, "source_only")
    (field,) = linear_residuals(before, source, [np.arange(len(source.train))], now)
    yield score(field, model="linear_residual", mode=mode)
    if target is None:
        return
    adapted, data = target
    for size, group in groupby(range(len(adapted)), adapted.size):
        runs = list(group)
        fields = linear_residuals(after, data, [adapted.subsets[run] for run in runs], after)
        for run, each in zip(runs, fields, strict=True):
            yield score(each, model="linear_residual", mode="scratch", n_train=size, seed=adapted.seeds[run])


def _choose_recipe(experiment: Experiment, outputs: Outputs, fold: Fold, candidate: Callable[[str], TrainedModel]):
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
