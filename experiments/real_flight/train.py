"""Where the models of one vehicle are trained: on plenty of flights before a change, on N windows after it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.folds import Fold, Lessons, drawn, lessons
from experiments.real_flight.logs import cut
from experiments.real_flight.models import (
    Craft,
    Lane,
    Trained,
    all_windows,
    fresh,
    in_stages,
    moved,
    refitted,
    settings_of,
)
from experiments.real_flight.recipes import RECIPES, before_a_change, share_of_epochs
from experiments.runner.stages import Stages
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.training.objective import Settings


@dataclass(frozen=True)
class Lesson:
    """What models of one recipe learn from, and what they minimise."""

    lessons: Lessons
    settings: Settings


@dataclass(frozen=True)
class Taught:
    """Models of one recipe, one lane each, stacked."""

    lanes: list[Lane]
    trained: Trained


@dataclass(frozen=True)
class Course:
    """The vehicle before and after the change, how it is learned, and the stages that are kept.

    Attributes:
        changes: whether there are flights from after the change.
    """

    before: Craft
    after: Craft
    config: RealFlightConfig
    stages: Stages
    changes: bool

    def lesson(self, fold: Fold, recipe: str) -> Lesson:
        """Plenty of flight before the change; its channels weigh all that is learned of the recipe."""
        found = lessons(fold, RECIPES[recipe].window, self.config.stride, self.config.validation)
        return Lesson(found, settings_of(self.before, found, RECIPES[recipe], self.config.batch_size))

    def lesson_after(self, fold: Fold, recipe: str, first: Lesson) -> Lesson:
        """Flight after the change, a window at every sample, weighed as before it."""
        return Lesson(lessons(fold, RECIPES[recipe].window, 1, self.config.validation), first.settings)

    def taught(self, name: str, model: str, recipe: str, lesson: Lesson, seeds: int) -> Taught:
        """A model of all windows of a lesson, one lane a seed."""
        everything = np.arange(len(lesson.lessons.train))
        lanes = [Lane(seed, everything, self.config.epochs) for seed in range(seeds)]
        how = RECIPES[recipe]
        start = fresh(model, self.before, how, self.config.hidden, seeds)
        steps = before_a_change(how) if self.changes else how.source
        what = (f"{name} {model} {recipe}", model, start, lanes, steps)
        return Taught(lanes, in_stages(*what, lesson.lessons, len(everything), lesson.settings, self.stages))

    def retaught(self, name: str, model: str, recipe: str, fold: Fold, lesson: Lesson, first: Taught) -> Taught:
        """The same once more, on the validation flights as well, for as many epochs as were best on these."""
        more = cut(fold.validation, RECIPES[recipe].window, self.config.stride)
        whole = all_windows(lesson.lessons, more)
        lanes = [Lane(each.seed, np.arange(len(whole.train)), each.share) for each in first.lanes]
        start = fresh(model, self.before, RECIPES[recipe], self.config.hidden, len(lanes))
        what = (f"{name} {model} {recipe}", model, start, lanes, RECIPES[recipe].source)
        return Taught(first.lanes, refitted(*what, whole, first.trained, lesson.settings, self.stages))

    def carried(self, taught: Taught) -> Taught:
        """The models on the vehicle after the change, as they are."""
        was = taught.trained
        fields = moved(was.fields, self.after.vehicle)
        return Taught(taught.lanes, Trained(fields, was.val_loss, was.epochs, was.best_epochs, was.status))

    def adapted(
        self, name: str, model: str, recipe: str, here: Lesson, start: Taught | None, sizes: Sequence[int], pool: int
    ) -> Taught:
        """A model for each size and seed, in this order, from a start that was carried over, or from scratch."""
        seeds = self.config.seeds if start is None else len(start.lanes)
        lanes = [
            Lane(
                seed,
                drawn(here.lessons.train.sizes, size, self.config.draw, seed),
                self.config.epochs * share_of_epochs(size),
            )
            for size in sizes
            for seed in range(seeds)
        ]
        how = RECIPES[recipe]
        fields: Any = (
            fresh(model, self.after, how, self.config.hidden, seeds) if start is None else start.trained.fields
        )
        fields = lane(fields, np.array([each.seed for each in lanes]))
        steps = how.scratch if start is None else how.adaptation
        what = (f"{name} {model} {recipe}", model, fields, lanes, steps)
        return Taught(lanes, in_stages(*what, here.lessons, pool, here.settings, self.stages))
