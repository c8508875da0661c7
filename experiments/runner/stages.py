"""Sweeps that are worth keeping: each is found in the cache by the hash of all that fixes it, or run."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console

from experiments.paper.config import Run
from experiments.reporting.environment import PACKAGES
from experiments.runner.checkpoint import Checkpoints
from experiments.runner.progress import PartLine, SweepLine, clock
from experiments.runner.run_record import require_same
from experiments.runner.signals import Held
from hybrid_jax.io.archive import Arrays, digest, load_archive, named_leaves, save_archive, with_leaves
from hybrid_jax.io.datasets import Dataset, content_hash, versions
from hybrid_jax.io.files import backup_path
from hybrid_jax.io.models import describe
from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.training import NO_MORE, Progress, Room, sweep
from hybrid_jax.training.fitting import FitState, RunConfig
from hybrid_jax.training.objective import Settings, TrajectoryLoss

FORMAT = "hybrid_jax sweep 1"
RECIPE = 1  # raise it when the same start, plan and data no longer give the same result
FIRST_COST = 0.3  # s to save a state, before it is known
FINISHED_BY = ("jax", "hybrid_jax")

Result = TypeVar("Result")


class Stages:
    """Runs each sweep once, goes on with one that was interrupted, and knows how long each took.

    Args:
        folder: where sweeps are kept, finished or not.
        console: where progress is drawn.
        saving: share of a sweep's time that saving its state may take.
        fresh: move aside sweeps that were begun, and finished ones of other versions, and run them anew.
    """

    def __init__(self, folder: Path, console: Console, saving: float = 0.02, fresh: bool = False):
        self._folder, self._console, self._share, self._fresh = folder, console, saving, fresh
        self.seconds: dict[str, float] = {}
        self.reused: list[str] = []
        self._ran = self._saving = 0.0

    def run(
        self, name: str, states: FitState, plans: RunConfig, settings: Settings, data: Dataset, room: Room = NO_MORE
    ) -> FitState:
        """The final states of a sweep on the train and validation splits of a dataset.

        Args:
            room: that its program has (see `sweep`); of no matter for what comes out.

        Raises:
            OtherRun: it was begun by other versions of the libraries.
            ValueError: what is kept of this sweep when finished is damaged; names the file, so that it can be deleted.
            OSError: the state cannot be saved.
        """
        identity = _identity(states, plans, settings, data)
        finished = self._folder / f"{_stem(name)}-{identity[:16]}.npz"
        begun = finished.with_suffix(".begun")
        if self._fresh and hosts.is_main_process():
            self._make_way(finished, begun)
        checkpoints = Checkpoints(begun)
        done, spent, states = self._found(name, states, finished, checkpoints, begun)
        if done:
            self.seconds[name] = spent
            self.reused.append(name)
            self._say(f"{name}: {summary(states)}, as found in the cache")
            return states
        with Held() as held:
            keeper = _Keeper(checkpoints, held, name, spent, self._share)
            states = self._sweep(name, states, plans, settings, data, room, keeper)
            self.seconds[name] = keeper.seconds()
            if hosts.is_main_process():
                _save(finished, name, states, self.seconds[name])
                checkpoints.delete()
        self._ran, self._saving = self._ran + keeper.seconds() - spent, self._saving + keeper.saving
        self._say(f"{name}: {summary(states)}, {clock(self.seconds[name])}")
        return states

    def timed(self, name: str, work: Callable[[], Result]) -> Result:
        """The result of work(), its seconds added to those under a name: two domains may have a stage of one name."""
        began = time.perf_counter()
        result = work()
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began
        return result

    def parts(self, name: str, jobs: Sequence[Callable[[], Result]]) -> list[Result]:
        """The results of jobs, one after the other, timed as one."""
        with PartLine(name, self._console, len(jobs)) as line:

            def one(number: int, job: Callable[[], Result]) -> Result:
                result = job()
                line.show(number)
                return result

            return self.timed(name, lambda: [one(number, job) for number, job in enumerate(jobs, 1)])

    def knows(self, name: str) -> bool:
        """Whether a sweep of this name, in whatever configuration, was begun or finished before."""
        return any(self._folder.glob(f"{_stem(name)}-*"))

    def notes(self) -> list[str]:
        """What a reader of the seconds must know."""
        found = ", ".join(self.reused)
        reused = [f"Taken from the cache, with the seconds that they took when they ran: {found}."] if found else []
        saved = [f"Saving the state of sweeps took {self._saving / self._ran:.2%} of their time."] if self._ran else []
        return reused + saved

    def _make_way(self, finished: Path, begun: Path) -> None:
        stale = finished.exists() and load_archive(finished, FORMAT)[0]["versions"] != versions(*FINISHED_BY)
        for path in [begun] * begun.exists() + [finished] * stale:
            self._say(f"{path}: moved aside to {path.rename(backup_path(path, 'before')).name}")

    def _found(
        self, name: str, start: FitState, finished: Path, checkpoints: Checkpoints, begun: Path
    ) -> tuple[bool, float, FitState]:
        """Whether the sweep is done, the seconds spent on it and its states, as process 0 has them."""

        def look() -> tuple[tuple[bool, float], Arrays]:
            done = finished.exists()
            states, spent = _load(finished, start) if done else self._goes_on(name, start, checkpoints, begun)
            return (done, spent), named_leaves(states)

        (done, spent), leaves = hosts.from_first(look)
        return done, spent, with_leaves(start, leaves, "process 0")

    def _goes_on(self, name: str, states: FitState, checkpoints: Checkpoints, begun: Path) -> tuple[FitState, float]:
        """The states from which to start, and the seconds already spent on them."""
        found = checkpoints.load(self._say)
        if found is None:
            return states, 0.0
        arrays, about = found
        require_same(f"{begun}: was begun with versions", about, {"versions": versions(*PACKAGES)})
        states, spent = with_leaves(states, arrays, begun), about["seconds"]
        self._say(f"{name}: goes on where it was interrupted, at epoch {states.epoch.max()}, after {clock(spent)}")
        return states, spent

    def _sweep(self, name, states, plans, settings, data: Dataset, room: Room, keeper: "_Keeper") -> FitState:
        with SweepLine(name, self._console) as line:

            def on_block(states: FitState, progress: Progress) -> None:
                line.show(progress)
                keeper.keep(states)

            train, validation = data.splits["train"], data.splits["validation"]
            try:
                return sweep(states, plans, train, validation, settings, room=room, on_block=on_block)
            except hosts.PeerLost:
                keeper.rescue()
                raise

    def _say(self, line: str) -> None:
        self._console.print(line, highlight=False, soft_wrap=True)


def stages_of(config: Run, console: Console) -> Stages:
    """The stages of an experiment, in its cache folder."""
    return Stages(config.cache / "sweeps", console, config.saving, config.fresh)


class _Keeper:
    """Saves a sweep after a block, as often as its share of the time allows, and when a signal waits.

    Attributes:
        saving: seconds spent on saving.
    """

    def __init__(self, checkpoints: Checkpoints, held: Held, name: str, spent: float, share: float):
        self._checkpoints, self._held, self._name, self._spent, self._share = checkpoints, held, name, spent, share
        self._began = time.perf_counter()
        self._cost = FIRST_COST
        self.saving = 0.0
        self._unsaved: FitState | None = None

    def seconds(self) -> float:
        """What the sweep has taken so far, earlier runs included."""
        return self._spent + time.perf_counter() - self._began

    def keep(self, states: FitState) -> None:
        """Save the states after a block if it is time; let a signal act that came during the block."""
        self._unsaved = states
        due = self.saving + self._cost < self._share * (self.seconds() - self._spent)
        if hosts.is_main_process() and (due or self._held.waiting):
            self._save(states)
        self._held.deliver()

    def rescue(self) -> None:
        """Save the last block, if it was not: another process has ended."""
        if self._unsaved is not None and hosts.is_main_process():
            self._save(self._unsaved)

    def _save(self, states: FitState) -> None:
        began = time.perf_counter()
        about = {"name": self._name, "seconds": self.seconds(), "versions": versions(*PACKAGES)}
        self._checkpoints.save(named_leaves(states), about)
        self._cost = time.perf_counter() - began
        self.saving += self._cost
        self._unsaved = None


def _stem(name: str) -> str:
    return name.replace(" ", "-")


def summary(states: FitState) -> str:
    """One line about a finished sweep."""
    first, last = states.epoch.min(), states.epoch.max()
    return f"{len(states.epoch)} lanes, {first} to {last} epochs, best validation loss {states.best_mse.min():.3g}"


def _identity(states: FitState, plans: RunConfig, settings: Settings, data: Dataset) -> str:
    regulariser = None if settings.regulariser is None else settings.regulariser.__name__
    shared = [settings.batch_size, regulariser, type(settings.solver).__name__]
    # Leaves say nothing of what is static in a field: the vehicle, how inputs are scaled.
    fixed = [RECIPE, *shared, *_described(settings.objective), describe(states.field), content_hash(data)]
    return digest(fixed, named_leaves({"start": states, "plan": plans}))


def _described(objective: Any) -> list[Any]:
    """An objective of another kind than the default one, as JSON values."""
    return [] if isinstance(objective, TrajectoryLoss) else [type(objective).__name__, asdict(objective)]


def _save(path: Path, name: str, states: FitState, seconds: float) -> None:
    about = {"name": name, "seconds": seconds, "versions": versions(*FINISHED_BY)}
    save_archive(path, FORMAT, about, named_leaves(states))


def _load(path: Path, like: FitState) -> tuple[FitState, float]:
    about, arrays = load_archive(path, FORMAT)
    return with_leaves(like, arrays, path), about["seconds"]
