"""Sweeps that are worth keeping: each is found in the cache by the hash of all that fixes it, or run."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console

from experiments.progress import SweepLine, clock
from hybrid_jax.archive import digest, load_archive, named_leaves, save_archive, with_leaves
from hybrid_jax.datasets import Dataset, content_hash, versions
from hybrid_jax.models import describe
from hybrid_jax.objective import Prediction, Settings
from hybrid_jax.sweep import Progress, sweep
from hybrid_jax.training import FitState, Plan

FORMAT = "hybrid_jax sweep 1"
RECIPE = 1  # raise it when the same start, plan and data no longer give the same result
SAVE_EVERY = 30.0  # s

Result = TypeVar("Result")


class Stages:
    """Runs each sweep once, goes on with one that was interrupted, and knows how long each took.

    Args:
        folder: where sweeps are kept, finished or not.
        console: where progress is drawn.
    """

    def __init__(self, folder: Path, console: Console):
        self._folder, self._console = folder, console
        self.seconds: dict[str, float] = {}
        self.reused: list[str] = []

    def run(self, name: str, states: FitState, plans: Plan, settings: Settings, data: Dataset) -> FitState:
        """The final states of a sweep on the train and validation splits of a dataset.

        Raises:
            ValueError: what is kept of this sweep is damaged; names the file, so that it can be deleted.
        """
        identity = _identity(states, plans, settings, data)
        finished = self._folder / f"{name.replace(' ', '-')}-{identity[:16]}.npz"
        begun = finished.with_suffix(".begun.npz")
        if finished.exists():
            states, self.seconds[name] = _load(finished, states)
            self.reused.append(name)
            self._say(f"{name}: {summary(states)}, as found in the cache")
            return states
        spent = 0.0
        if begun.exists():
            states, spent = _load(begun, states)
            self._say(f"{name}: goes on where it was interrupted, after {clock(spent)}")
        final = self._sweep(name, states, plans, settings, data, _Keeper(begun, name, spent))
        self.seconds[name] = final[1]
        _save(finished, name, *final)
        begun.unlink(missing_ok=True)
        self._say(f"{name}: {summary(final[0])}, {clock(final[1])}")
        return final[0]

    def timed(self, name: str, work: Callable[[], Result]) -> Result:
        """The result of work(), its seconds noted under a name."""
        began = time.perf_counter()
        result = work()
        self.seconds[name] = time.perf_counter() - began
        return result

    def notes(self) -> list[str]:
        """What a reader of the seconds must know."""
        found = ", ".join(self.reused)
        return [f"Taken from the cache, with the seconds that they took when they ran: {found}."] if found else []

    def _sweep(self, name, states, plans, settings, data: Dataset, keeper: "_Keeper") -> tuple[FitState, float]:
        with SweepLine(name, self._console) as line, keeper:

            def on_block(states: FitState, progress: Progress) -> None:
                line.show(progress)
                keeper.keep(states)

            final = sweep(states, plans, data.splits["train"], data.splits["validation"], settings, on_block=on_block)
        return final, keeper.seconds()

    def _say(self, line: str) -> None:
        self._console.print(line, highlight=False, soft_wrap=True)


class _Keeper(AbstractContextManager):
    """Saves a sweep now and then, and when it is interrupted, with the seconds that it has taken in all."""

    def __init__(self, path: Path, name: str, spent: float):
        self._path, self._name, self._spent = path, name, spent
        self._began = self._saved = time.perf_counter()
        self._latest: FitState | None = None

    def __exit__(self, kind, error, trace) -> None:
        if kind is not None and issubclass(kind, KeyboardInterrupt):
            self._save()

    def seconds(self) -> float:
        """What the sweep has taken so far, earlier runs included."""
        return self._spent + time.perf_counter() - self._began

    def keep(self, states: FitState) -> None:
        """Remember the states after a block; save them if the last time is a while ago."""
        self._latest = states
        if time.perf_counter() - self._saved > SAVE_EVERY:
            self._save()

    def _save(self) -> None:
        if self._latest is not None:
            _save(self._path, self._name, self._latest, self.seconds())
        self._saved = time.perf_counter()


def summary(states: FitState) -> str:
    """One line about a finished sweep."""
    first, last = states.epoch.min(), states.epoch.max()
    return f"{len(states.epoch)} lanes, {first} to {last} epochs, best validation loss {states.best_mse.min():.3g}"


def _identity(states: FitState, plans: Plan, settings: Settings, data: Dataset) -> str:
    regulariser = None if settings.regulariser is None else settings.regulariser.__name__
    shared = [settings.batch_size, regulariser, type(settings.solver).__name__]
    # Leaves say nothing of what is static in a field: the vehicle, how inputs are scaled.
    fixed = [RECIPE, *shared, *_described(settings.objective), describe(states.field), content_hash(data)]
    return digest(fixed, named_leaves({"start": states, "plan": plans}))


def _described(objective: Any) -> list[Any]:
    """An objective of another kind than the default one, as JSON values."""
    return [] if isinstance(objective, Prediction) else [type(objective).__name__, asdict(objective)]


def _save(path: Path, name: str, states: FitState, seconds: float) -> None:
    about = {"name": name, "seconds": seconds, "versions": versions("jax", "hybrid_jax")}
    save_archive(path, FORMAT, about, named_leaves(states))


def _load(path: Path, like: FitState) -> tuple[FitState, float]:
    about, arrays = load_archive(path, FORMAT)
    return with_leaves(like, arrays, path), about["seconds"]
