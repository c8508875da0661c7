"""The course on recorded flights: learn from the source, adapt in each fold, test on what was held out."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from rich.console import Console

from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.folds import Fold, folds_of, hold_out_validation, require_windows
from experiments.real_flight.logs import Flown, cut
from experiments.real_flight.models import Craft
from experiments.real_flight.recipes import RECIPES, alike
from experiments.real_flight.rows import least
from experiments.real_flight.scoring import (
    INTERVAL_STEPS,
    Scored,
    Trial,
    linear_residuals,
    on,
    parameters,
    relative_error,
    score,
    score_lanes,
    trial_of,
)
from experiments.real_flight.train import Course, Lesson, Taught
from experiments.runner.stages import Stages, stages_of
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.baselines import HoldState
from hybrid_jax.dynamics.multirotor import multirotor
from hybrid_jax.flights.scores import flight_errors
from hybrid_jax.sweep.lanes import count, lane
from hybrid_jax.training import stages

TRIALS = 2  # seeds by which a recipe is chosen
FROM_SCRATCH = ("hybrid",)  # whose scratch tells what the source is worth


@dataclass(frozen=True)
class Study:
    """What was found.

    Attributes:
        scored: every test.
        folds: in order.
        choices: of each fold, by recipe, the validation error over the baseline's; empty where there was no choice.
        shown: models of the first fold by (model, mode), for figures.
        stages: know how long what took.
    """

    scored: list[Scored]
    folds: list[Fold]
    choices: dict[str, dict[str, float]]
    taught: dict[tuple[int, str, str], Taught]
    stages: Stages


def study(before: Craft, after: Craft, flown: Mapping[str, Flown], config: RealFlightConfig, console: Console) -> Study:
    """Train and test all there is to; finished stages come from the cache.

    Args:
        flown: "source" and, as far as there are any, "target" and "test".

    Raises:
        ValueError: too few flights, or too little flight in them, for what is asked.
    """
    course = Course(before, after, config, stages_of(config, console), "target" in flown)
    tested = flown["test"].logs if "test" in flown else None
    folds = folds_of(flown.get("target", flown["source"]).logs, tested, config)
    school = Fold("source", *hold_out_validation(flown["source"].logs, config), []) if "target" in flown else None
    require_windows(folds, school, config)
    found = Study([], folds, {}, {}, course.stages)
    if school:
        _adapt(course, school, found)
    else:
        _train(course, found)
    return found


def in_turn(folds: Sequence[Fold]) -> Iterator[tuple[int, Fold]]:
    """The folds with their numbers; in each, the programs of the one before are let go of.

    A program of a sweep takes hundreds of memory maps, and Linux gives a process 65 530.
    """
    for number, fold in enumerate(folds):
        jax.clear_caches()
        yield number, fold


def _train(course: Course, found: Study) -> None:
    """In each fold, models of its flights, tested as they are."""
    config = course.config
    for number, fold in in_turn(found.folds):
        where, trial = f"fold {number}", trial_of(fold, config)
        chosen = _chosen(course, found, fold, lambda name, fold=fold, where=where: _tried(course, where, fold, name))
        lesson = course.lesson(fold, chosen)
        found.scored.extend(_baselines(trial, course.before))
        for model in config.models:
            recipe = alike(model, chosen, config.tried)
            taught = course.taught(where, model, recipe, lesson, config.seeds)
            if config.refit:
                taught = course.retaught(where, model, recipe, fold, lesson, taught)
            known = _known(taught, lesson)
            found.scored.extend(score_lanes(trial, model, "source_only", recipe, taught.lanes, taught.trained, known))
            found.taught[number, model, "source_only"] = taught
        found.scored.append(_linear_of_source(trial, course.before, course.before, lesson, "source_only"))


def _adapt(course: Course, school: Fold, found: Study) -> None:
    """Source models of each recipe that is chosen, and in each fold what becomes of them."""
    config = course.config
    pool = max(len(cut(fold.train, RECIPES[name].window)) for fold in found.folds for name in config.tried)
    taught: dict[tuple[str, str], Taught] = {}
    first = {name: course.lesson(school, name) for name in config.tried}
    for number, fold in in_turn(found.folds):
        where, trial = f"fold {number}", trial_of(fold, config)

        def tried(recipe: str, where=where, fold=fold) -> list[AbstractVectorField]:
            return _tried_after(course, where, first[recipe], fold, recipe, pool)

        chosen = _chosen(course, found, fold, tried)
        lesson = first[chosen]
        here = course.lesson_after(fold, chosen, lesson)
        found.scored.extend(_baselines(trial, course.after))
        for model in config.models:
            recipe = alike(model, chosen, config.tried)
            if (model, recipe) not in taught:
                taught[model, recipe] = course.taught("source", model, recipe, lesson, config.seeds)
            source = taught[model, recipe]
            carried = course.carried(source)
            found.taught[number, model, "zero_shot"] = carried
            known = _known(source, lesson)
            found.scored.extend(score_lanes(trial, model, "zero_shot", recipe, carried.lanes, carried.trained, known))
            starts = {"fine_tuned": carried} | ({"scratch": None} if model in FROM_SCRATCH else {})
            for mode, start in starts.items():
                after = course.adapted(f"{where} {mode}", model, recipe, here, start, config.n, pool)
                known = _known(after, here)
                found.scored.extend(score_lanes(trial, model, mode, recipe, after.lanes, after.trained, known))
                found.taught[number, model, mode] = after
        found.scored.append(_linear_of_source(trial, course.before, course.after, lesson, "zero_shot"))
        found.scored.extend(_linear_after(course, trial, here, after.lanes))


def _chosen(course: Course, found: Study, fold: Fold, tried: Callable[[str], Sequence[AbstractVectorField]]) -> str:
    """The recipe whose hybrids do best on the fold's validation flights; of one, that one."""
    names = course.config.tried
    if len(names) == 1:
        return names[0]
    windows = cut(fold.validation, course.config.longest).windows
    baseline = flight_errors(course.after.thrust(), windows)

    def error(field: AbstractVectorField) -> float:
        return relative_error(flight_errors(field, windows), baseline, course.config.horizon)

    errors = {name: float(np.mean([error(field) for field in tried(name)])) for name in names}
    found.choices[fold.name] = errors
    return least(errors)


def _tried(course: Course, where: str, fold: Fold, recipe: str) -> list[AbstractVectorField]:
    """Hybrids of a fold, of a few seeds; what judges them they have not learned from."""
    lesson = course.lesson(fold, recipe)
    return _fields(course.taught(f"choice {where}", "hybrid", recipe, lesson, min(TRIALS, course.config.seeds)))


def _tried_after(
    course: Course, where: str, lesson: Lesson, fold: Fold, recipe: str, pool: int
) -> list[AbstractVectorField]:
    """Hybrids of the source, fine-tuned on the most windows of a fold."""
    source = course.taught("choice source", "hybrid", recipe, lesson, min(TRIALS, course.config.seeds))
    here, most = course.lesson_after(fold, recipe, lesson), max(course.config.n)
    return _fields(course.adapted(f"choice {where}", "hybrid", recipe, here, course.carried(source), [most], pool))


def _known(taught: Taught, lesson: Lesson) -> list[dict[str, Any]]:
    """θ_p of what was taught, and its intervals."""
    objective: Any = lesson.settings.objective
    return parameters(taught.trained.fields, taught.lanes, lesson.lessons.train, objective)


def _fields(taught: Taught) -> list[AbstractVectorField]:
    return [lane(taught.trained.fields, index) for index in range(count(taught.trained.fields))]


def _baseline(model: str, mode: str, n_train: int = 0, seed: int = 0) -> dict[str, Any]:
    return {"model": model, "mode": mode, "n_train": n_train, "seed": seed, "recipe": ""}


def _baselines(trial: Trial, craft: Craft) -> list[Scored]:
    fields = {"hold": HoldState(), "thrust": craft.thrust()}
    return [score(trial, field, **_baseline(model, "nominal")) for model, field in fields.items()]


def _linear(craft: Craft, lesson: Lesson, subsets: Sequence[np.ndarray]) -> Any:
    windows = lesson.lessons.train.windows
    short = stages.cut(windows, min(INTERVAL_STEPS, windows.horizon))
    return linear_residuals(_rigid(craft), short, subsets, lesson.lessons.validation)


def _rigid(craft: Craft) -> AbstractVectorField:
    return multirotor(craft.vehicle, (), craft.terms)


def _linear_of_source(trial: Trial, before: Craft, after: Craft, lesson: Lesson, mode: str) -> Scored:
    """The rigid body with a linear residual of all source windows, on the vehicle as it is now."""
    linear = _linear(before, lesson, [np.arange(len(lesson.lessons.train))])
    return score(trial, on(_rigid(after), linear)[0], **_baseline("linear_residual", mode))


def _linear_after(course: Course, trial: Trial, here: Lesson, lanes: Sequence) -> list[Scored]:
    """The rigid body with a linear residual of each lane's windows."""
    scored = []
    for size in course.config.n:
        own = [each for each in lanes if len(each.subset) == size]
        fields = on(_rigid(course.after), _linear(course.after, here, [each.subset for each in own]))
        known = [_baseline("linear_residual", "scratch", size, each.seed) for each in own]
        scored += [score(trial, field, **row) for field, row in zip(fields, known, strict=True)]
    return scored
