"""Train, choose and test in every fold."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from typing import Any

import jax
import numpy as np

from experiments.real_flight import scoring, train
from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.folds import (
    GROUP_BY,
    Fold,
    evenly_spaced,
    hold_out_validation,
    leave_out,
    make_folds,
    require_windows,
    sampled_indices,
)
from experiments.real_flight.models import RECIPES, equivalent_recipe, thrust_baseline
from experiments.real_flight.scoring import (
    BASELINES,
    QUANTITIES,
    SUM,
    TAGS,
    Replicates,
    Test,
    linear_residuals,
    parameters,
)
from experiments.real_flight.selection import Candidate, Selection
from experiments.real_flight.train import Experiment, TrainedModel, TrainingData
from experiments.reporting import names
from experiments.reporting.results import Results
from hybrid_jax.cli import choice
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.baselines import HoldState
from hybrid_jax.dynamics.composition import Blend
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.flights.scores import flight_errors
from hybrid_jax.flights.windows import count_windows, cut_windows, require_length
from hybrid_jax.trajectories import Trajectories

CHOICE_SEEDS = 2  # seeds that are trained to choose a candidate
CHOICE_WINDOWS = 500  # windows of a flight, or manoeuvre, that candidates are compared on

Source = tuple[Callable[[str], TrainingData], Callable[..., TrainedModel]]


@dataclass(frozen=True)
class Outputs:
    folds: list[Fold]
    tests: list[Test] = field(default_factory=list)
    selections: list[Selection] = field(default_factory=list)  # of each fold and N
    trained: dict[tuple[int, str, str], TrainedModel] = field(default_factory=dict)  # by number of fold, model, mode
    chosen: dict[tuple[int, int, int], AbstractVectorField] = field(default_factory=dict)  # number of fold, N, seed

    @property
    def table(self) -> Results:
        return Results([test.row for test in self.tests], TAGS)

    @property
    def replicates(self) -> Results:
        """The scores of every model on each test flight, or manoeuvre."""
        return Results([row for test in self.tests for row in test.replicates], (*TAGS, "replicate"))


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


def source_of(experiment: Experiment, name: str, fold: Fold, like: Source | None = None) -> Source:
    """Data of the flights before the change, by recipe, and models trained on them; each is made once.

    With `like`, loss and shapes are those of its data, so that both share their programs.
    """

    @cache
    def data(recipe: str) -> TrainingData:
        if like is None:
            return train.training_data(experiment, fold, recipe)
        both = cut_windows(
            [*fold.train, *fold.validation, *fold.test], RECIPES[recipe].window, experiment.config.stride
        )
        return train.training_data(experiment, fold, recipe, like[0](recipe).objective, capacity=len(both))

    @cache
    def trained(model: str, recipe: str, seeds: int) -> TrainedModel:
        prefix = "choice " if seeds < experiment.config.seeds else ""
        return train.train_on_source(experiment, f"{prefix}{name}", model, recipe, data(recipe), seeds)

    return data, trained


def candidates(config: RealFlightConfig) -> list[Candidate]:
    """Baselines, and models with their recipes, the simplest first; of those trained in the same way, one."""
    learned = [
        Candidate(model, recipe)
        for model in (names.PHYSICS_ONLY, names.HYBRID)
        for recipe in config.tried
        if model in config.models and equivalent_recipe(model, recipe, config.tried) == recipe
    ]
    return [*map(Candidate, reversed(BASELINES)), *learned]


class Trainer:
    """Trains the candidates of one fold, each once."""

    def __init__(self, experiment: Experiment, name: str, fold: Fold, source: Source, capacity: int):
        self.experiment, self.name, self.fold, self.capacity = experiment, name, fold, capacity
        self.adapts = "target" in experiment.logs
        self.mode = names.FINE_TUNED if self.adapts else names.SOURCE_ONLY  # of what is delivered
        self.source_data, self.source_model = source

    @cache  # noqa: B019 - a trainer lives as long as its fold
    def target_data(self, recipe: str) -> TrainingData:
        loss = self.source_data(recipe).objective
        return train.training_data(self.experiment, self.fold, recipe, loss, 1, self.capacity)

    @cache  # noqa: B019
    def trained(self, model: str, recipe: str, seeds: int, mode: str) -> TrainedModel:
        """A model adapted to each N, or without a target trained on all flights of the fold."""
        experiment, first = self.experiment, self.source_model(model, recipe, seeds)
        if self.adapts:
            start, data = train.transfer(experiment, first), self.target_data(recipe)
            return train.adapt(experiment, self.name, mode, start, data, experiment.config.n)
        again = experiment.config.refit
        return train.refit(experiment, self.name, self.fold, self.source_data(recipe), first) if again else first

    def fields(self, candidate: Candidate, seeds: int, size: int) -> Sequence[AbstractVectorField]:
        """A candidate for an N of the configuration, 0 without a target: a field per seed, or one if all are equal."""
        model = candidate.model
        if candidate.parts:
            parts = [self.fields(part, seeds, size) for part in candidate.parts]
            return [Blend(each) for each in zip(*parts, strict=True)]
        if candidate.recipe:
            trained = self.trained(model, candidate.recipe, seeds, self.mode)
            first = self.experiment.config.n.index(size) * seeds if self.adapts else 0
            return [trained.run(first + seed) for seed in range(seeds)]
        if model == names.LINEAR_RESIDUAL:
            return self.linear_residuals(seeds, size)
        vehicle = self.experiment.after if self.adapts else self.experiment.before
        return [HoldState() if model == names.HOLD else thrust_baseline(vehicle)]

    def linear_residuals(self, seeds: int, size: int) -> Sequence[AbstractVectorField]:
        """Linear residuals of the rigid body, fitted to N target windows; with N = 0 to all windows of the source."""
        config, recipe = self.experiment.config, self.experiment.config.tried[0]
        before, after = (rigid_body(e.vehicle, (), e.terms) for e in (self.experiment.before, self.experiment.after))
        if size == 0:
            data = self.source_data(recipe)
            return linear_residuals(before, data, [np.arange(len(data.train))], after if self.adapts else before)
        data = self.target_data(recipe)
        size = min(size, len(data.train))
        subsets = [sampled_indices(data.train.sizes, size, config.draw, seed) for seed in range(seeds)]
        return linear_residuals(after, data, subsets, after)

    @cached_property
    def tested(self) -> dict[str, Trajectories]:
        """Windows of each test flight, or manoeuvre, that is long enough."""
        config, groups = self.experiment.config, {}
        for log in self.fold.test:
            groups.setdefault(GROUP_BY[config.validated_by](log), []).append(log)
        long = {name: logs for name, logs in groups.items() if count_windows(logs, config.longest)}
        cut = {name: cut_windows(logs, config.longest).windows for name, logs in long.items()}
        return {name: evenly_spaced(windows, CHOICE_WINDOWS) for name, windows in cut.items()}

    def test_windows(self) -> tuple[Trajectories, Replicates]:
        """All windows of the test flights, and which belong to each flight, or manoeuvre."""
        config = self.experiment.config
        logs = require_length(self.fold.test, config.longest)
        cut, of = cut_windows(logs, config.longest), GROUP_BY[config.validated_by]
        names = np.repeat([of(log) for log in logs], cut.sizes)
        return cut.windows, [(name, names == name) for name in dict.fromkeys(names.tolist())]

    def log_errors(self, candidate: Candidate, seeds: int, size: int) -> np.ndarray:
        """Logs of a candidate's errors, (flights, seeds, labels, quantities)."""
        fields, config = self.fields(candidate, seeds, size), self.experiment.config

        def of(field: AbstractVectorField, windows: Trajectories) -> np.ndarray:
            found = scoring.scores(*scoring.by_step(flight_errors(field, windows)), config)
            return np.array([list(errors.values()) for errors in found.values()])

        errors = [[of(field, windows) for field in fields] for windows in self.tested.values()]
        shape = (-1, len(fields), len(scoring.labels(config)), len(QUANTITIES))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log(np.reshape(errors, shape)).repeat(seeds // len(fields), axis=1)


def select(trainer: Trainer, inner: Sequence[Trainer], size: int) -> Selection:
    """Choose a candidate by the flights that each of the inner folds leaves out of training."""
    config = trainer.experiment.config
    seeds, labels = min(CHOICE_SEEDS, config.seeds), scoring.labels(config)
    judged = [labels.index(SUM)] if SUM in labels else range(len(labels))

    baselines = [*map(Candidate, BASELINES)]

    @cache
    def errors(candidate: Candidate) -> np.ndarray:
        return np.concatenate([each.log_errors(candidate, seeds, size) for each in inner])

    def scored(candidate: Candidate) -> np.ndarray:
        return (errors(candidate) - errors(Candidate(names.THRUST)))[:, :, judged].mean(axis=(2, 3))

    scores = {candidate: scored(candidate) for candidate in candidates(config)}
    if pair := choice.undecided(scores, baselines):
        both = Candidate.blend(pair)
        scores[both] = scored(both)
    chosen = choice.choose(scores, baselines)
    left_out = [name for each in inner for name in each.tested]
    observed = np.exp(trainer.log_errors(chosen, config.seeds, size).mean(axis=1))
    expected = choice.expected(errors(chosen).mean(axis=1))
    found = dict(zip(trainer.tested, observed, strict=True))
    return Selection(trainer.fold.name, size, chosen, left_out, scores, expected, labels, found)


def recipe_of(selected: Selection, config: RealFlightConfig) -> str:
    """The recipe of the models in the report: the chosen one, or with a baseline that of the best learned candidate."""
    learned = {name: each.mean() for name, each in selected.scores.items() if name.recipe and np.isfinite(each).all()}
    best = selected.chosen if selected.chosen in learned else min(learned, key=learned.__getitem__, default=None)
    return best.recipe if best else config.tried[0]


def _run_fold(experiment: Experiment, outputs: Outputs, number: int, source: Source) -> None:
    """Choose a candidate, train every model, adapt it if there is a target, and test."""
    config, fold, name = experiment.config, outputs.folds[number], f"fold {number}"
    windows = {RECIPES[recipe].window for recipe in config.tried}
    capacity = max(count_windows(each.train, steps) for each in outputs.folds for steps in windows)
    trainer = Trainer(experiment, name, fold, source, capacity)
    inner = []
    for part, left_out in enumerate(leave_out(fold, config)):
        own = f"{name} without {part}"
        its_source = source if trainer.adapts else source_of(experiment, own, left_out, source)
        inner.append(Trainer(experiment, own, left_out, its_source, capacity))
    sizes = config.n if trainer.adapts else (0,)
    selections = [select(trainer, inner, size) for size in sizes]
    outputs.selections.extend(selections)
    outputs.tests.extend(_test(trainer, outputs, number, selections))


def _test(trainer: Trainer, outputs: Outputs, number: int, selections: Sequence[Selection]) -> Iterable[Test]:
    """Test all models of a fold, with the recipe that was chosen for the largest N, and what was chosen."""
    config = trainer.experiment.config
    windows, replicates = trainer.test_windows()
    score = partial(scoring.score, windows=windows, replicates=replicates, config=config, fold=trainer.fold.name)
    for model in (names.HOLD, names.THRUST):
        yield score(*trainer.fields(Candidate(model), 1, 0), model=model, mode=names.NOMINAL)
    chosen = recipe_of(max(selections, key=lambda each: each.n_train), config)
    for model in config.models:
        for trained, theta in _models(trainer, model, equivalent_recipe(model, chosen, config.tried)):
            outputs.trained[number, trained.model, trained.mode] = trained
            yield from scoring.score_model(score, trained, theta)
    yield from _linear_baselines(trainer, score)
    for selected in selections:
        size = selected.n_train
        fields = trainer.fields(selected.chosen, config.seeds, size)
        for seed in range(config.seeds):
            outputs.chosen[number, size, seed] = each = fields[seed % len(fields)]
            tags = {"model": names.CHOSEN, "mode": trainer.mode, "n_train": size, "seed": seed}
            yield score(each, **tags, recipe=str(selected.chosen))


def _models(trainer: Trainer, model: str, recipe: str) -> Iterable[tuple[TrainedModel, list[dict[str, Any]]]]:
    """A model of a recipe with its θ_p; with a target, as it came from the source and then adapted."""
    seeds = trainer.experiment.config.seeds
    if not trainer.adapts:
        trained = trainer.trained(model, recipe, seeds, trainer.mode)
        yield trained, parameters(trained, trainer.source_data(recipe))
        return
    first = trainer.source_model(model, recipe, seeds)
    yield train.transfer(trainer.experiment, first), parameters(first, trainer.source_data(recipe))
    # From scratch: what the source is worth.
    for mode in (names.FINE_TUNED, names.SCRATCH) if model == names.HYBRID else (names.FINE_TUNED,):
        trained = trainer.trained(model, recipe, seeds, mode)
        yield trained, parameters(trained, trainer.target_data(recipe))


def _linear_baselines(trainer: Trainer, score: Callable[..., Test]) -> Iterable[Test]:
    """Test linear residuals of the rigid body, fitted to all source windows and to those of each run on the target."""
    config, model = trainer.experiment.config, names.LINEAR_RESIDUAL
    mode = names.ZERO_SHOT if trainer.adapts else names.SOURCE_ONLY
    yield score(*trainer.linear_residuals(1, 0), model=model, mode=mode)
    for size in config.n if trainer.adapts else ():
        for seed, each in enumerate(trainer.linear_residuals(config.seeds, size)):
            yield score(each, model=model, mode=names.SCRATCH, n_train=size, seed=seed)
