"""Sweeps and other jobs with a cache: what is finished is loaded, what was interrupted goes on, any other is run."""

import hashlib
import json
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from filelock import FileLock, Timeout
from rich.console import Console

from experiments.reporting.results import Row
from experiments.runner.checkpoint import Autosave, Checkpoints, DeferredSignals
from experiments.runner.options import Run
from experiments.runner.progress import Line, clock
from experiments.runner.run_record import PACKAGES, require_same
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.io.archive import Arrays, digest, load_archive, named_leaves, save_archive, with_leaves
from hybrid_jax.io.datasets import Dataset, content_hash, versions
from hybrid_jax.io.files import backup_path, json_value
from hybrid_jax.io.models import describe
from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.training import Progress, sweep
from hybrid_jax.training.fitting import FitState, RunConfig
from hybrid_jax.training.objective import Settings, TrajectoryLoss

FORMAT, JOB_FORMAT = "hybrid_jax sweep 1", "hybrid_jax job 1"
RECIPE = 1  # increment when the same start, plan and data no longer give the same result
FINISHED_BY = ("jax", "hybrid_jax")

Result = TypeVar("Result")
Found = tuple[Sequence[Row], dict[str, np.ndarray]]  # of a job: rows, and arrays by name
Job = Callable[[], Found]
Kept = Callable[[str, Mapping[str, Job]], dict[str, Found]]  # `Stages.kept` of some inputs


class Stages:
    """The stages of an experiment: training sweeps cached in a folder, and the time that each stage took.

    `saving` is as in `Run`; with `fresh`, unfinished sweeps, and those of other versions, are moved aside and run anew.
    """

    def __init__(self, folder: Path, console: Console, saving: float = 0.02, fresh: bool = False):
        self._folder, self._console, self._share, self._fresh = folder, console, saving, fresh
        self.seconds: dict[str, float] = {}  # by stage
        self.reused: list[str] = []  # sweeps that came from the cache
        self._ran = self._saving = 0.0

    def run(
        self,
        name: str,
        states: FitState,
        plans: RunConfig,
        settings: Settings,
        data: Dataset,
        min_capacity: tuple[int, int] = (0, 0),
    ) -> FitState:
        """The final states of a sweep on the train and validation splits of a dataset; see `sweep`.

        Two processes with one cache do not train the same sweep: the second waits for the first.

        Raises:
            OtherRun: the sweep was begun by other versions of the libraries.
            ValueError: the cached result is damaged; the message names the file, so that it can be deleted.
            OSError: the state cannot be saved.
        """
        finished = self._folder / f"{_stem(name)}-{_identity(states, plans, settings, data)[:16]}.npz"
        with self._alone(name, finished.with_suffix(".lock")):
            return self._run(name, states, plans, settings, data, min_capacity, finished)

    def _run(self, name, states, plans, settings, data, min_capacity, finished: Path) -> FitState:
        begun = finished.with_suffix(".begun")
        checkpoints = Checkpoints(begun)
        if self._fresh and hosts.is_main_process():
            self._back_up(finished, begun)

        def look() -> tuple[tuple[bool, float], Arrays]:
            """Whether the sweep is finished, the seconds spent on it, and its states."""
            if finished.exists():
                about, arrays = load_archive(finished, FORMAT)
                return (True, about["seconds"]), arrays
            if (found := checkpoints.load(self._say)) is None:
                return (False, 0.0), named_leaves(states)
            require_same(f"{begun}: was begun with versions", found[0], {"versions": versions(*PACKAGES)})
            return (False, found[0]["seconds"]), found[1]

        (done, spent), arrays = hosts.from_first(look)
        states = with_leaves(states, arrays, finished if done else begun)
        if done:
            self.seconds[name] = spent
            self.reused.append(name)
            self._say(f"{name}: {summary(states)}, as found in the cache")
            return states
        if spent:
            self._say(f"{name}: goes on where it was interrupted, at epoch {states.epoch.max()}, after {clock(spent)}")
        with DeferredSignals() as signals, Line(name, self._console) as line:
            autosave = Autosave(checkpoints, signals, name, spent, self._share)

            def on_block(states: FitState, progress: Progress) -> None:
                line.show_sweep(progress)
                autosave.after_block(states)

            splits = data.splits["train"], data.splits["validation"]
            try:
                states = sweep(states, plans, *splits, settings, min_capacity=min_capacity, on_block=on_block)
            except hosts.PeerLost:
                autosave.save_last_block()
                raise
            self.seconds[name] = autosave.seconds()
            if hosts.is_main_process():
                about = {"name": name, "seconds": self.seconds[name], "versions": versions(*FINISHED_BY)}
                save_archive(finished, FORMAT, about, named_leaves(states))
                checkpoints.delete()
        self._ran += self.seconds[name] - spent
        self._saving += autosave.saving
        self._say(f"{name}: {summary(states)}, {clock(self.seconds[name])}")
        return states

    def timed(self, name: str, work: Callable[[], Result], doing: str = "") -> Result:
        """The result of `work()`; its time is added to that of the stage `name`. `doing` is shown meanwhile."""
        began = time.perf_counter()
        with Line(name, self._console, doing) if doing else nullcontext():
            result = work()
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began
        return result

    def parts(self, name: str, jobs: Sequence[Callable[[], Result]]) -> list[Result]:
        """The results of jobs run one after the other, with progress, as one timed stage."""
        results: list[Result] = []
        with Line(name, self._console, "compiling and solving") as line:
            for job in jobs:
                results.append(self.timed(name, job))
                line.show_parts(len(results), len(jobs))
        return results

    def kept(self, name: str, jobs: Mapping[str, Job], identity: str) -> dict[str, Found]:
        """Rows and arrays of each job, as by `parts`; they are kept in the cache, and so run once.

        `identity` says what determines them, besides their names; see `identity_of`.
        """
        folder = self._folder / f"{_stem(name)}-{identity[:16]}"
        if self._fresh and folder.exists() and hosts.is_main_process():
            self._say(f"{folder}: moved aside to {folder.rename(backup_path(folder, 'before')).name}")
        paths = {job: folder / f"{_stem(job)}.npz" for job in jobs}
        found = {job: self._load(name, path) for job, path in paths.items() if path.exists()}
        if found:
            self.reused.append(name if len(found) == len(jobs) else f"{len(found)} of {len(jobs)} parts of {name}")
        missing = [job for job in jobs if job not in found]
        if missing:
            ran = self.parts(name, [partial(_run_and_save, paths[job], jobs[job]) for job in missing])
            found |= dict(zip(missing, ran, strict=True))
        return {job: found[job] for job in jobs}

    def knows(self, name: str) -> bool:
        """Whether the cache holds a sweep of this name, in any configuration, finished or not."""
        return any(self._folder.glob(f"{_stem(name)}-*"))

    def notes(self) -> list[str]:
        """Remarks on the times in `seconds`."""
        reused = f"Taken from the cache, with the seconds of the run that made them: {', '.join(self.reused)}."
        saved = f"Saving checkpoints took {self._saving / (self._ran or 1):.2%} of the sweeps' time."
        return [reused] * bool(self.reused) + [saved] * bool(self._ran)

    @contextmanager
    def _alone(self, name: str, path: Path) -> Iterator[None]:
        """Hold the lock file of a sweep; wait while another process does."""
        if not hosts.is_main_process():  # it alone reads and writes
            yield
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(path)  # released with the process
        try:
            lock.acquire(timeout=0)
        except Timeout:
            with Line(name, self._console, "waiting for another run with this cache, which is at it"):
                lock.acquire()
        try:
            yield
        finally:
            lock.release()

    def _load(self, stage: str, path: Path) -> Found:
        """What a job found before; its seconds are added to the stage's."""
        about, arrays = load_archive(path, JOB_FORMAT)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + about["seconds"]
        return json.loads(about["rows"]), arrays

    def _back_up(self, finished: Path, begun: Path) -> None:
        stale = finished.exists() and load_archive(finished, FORMAT)[0]["versions"] != versions(*FINISHED_BY)
        for path in [begun] * begun.exists() + [finished] * stale:
            self._say(f"{path}: moved aside to {path.rename(backup_path(path, 'before')).name}")

    def _say(self, line: str) -> None:
        self._console.print(line, highlight=False, soft_wrap=True)


def rows_of(found: Mapping[str, Found]) -> list[Row]:
    """The rows of all jobs, in their order."""
    return [row for rows, _ in found.values() for row in rows]


def stages_of(config: Run, console: Console) -> Stages:
    """The stages of an experiment, cached in its cache folder."""
    return Stages(config.cache / "sweeps", console, config.saving, config.fresh)


def identity_of(*inputs: Any) -> str:
    """Of jobs: what determines their results, given as JSON, datasets and fields, and the code of these packages.

    Inputs do not say what is done with them, so any edit makes jobs anew.
    """
    sources = [source_digest(package) for package in ("hybrid_jax", "experiments")]
    fixed: list[Any] = [RECIPE, *sources, versions(*FINISHED_BY)]
    arrays: dict[str, Any] = {}
    for value in inputs:
        match value:
            case AbstractVectorField():
                fixed.append(describe(value))
                arrays |= {f"{len(fixed)}.{name}": leaf for name, leaf in named_leaves(value).items()}
            case Dataset():
                fixed.append(content_hash(value))
            case _:
                fixed.append(json_value(value))
    return digest(fixed, arrays)


@cache
def source_digest(package: str) -> str:
    """The digest of all Python files of a package."""
    spec = find_spec(package)
    digest = hashlib.sha256()
    for root in sorted(spec.submodule_search_locations or ()) if spec else ():
        for path in sorted(Path(root).rglob("*.py")):
            digest.update(f"{path.relative_to(root)}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def _run_and_save(path: Path, work: Job) -> Found:
    began = time.perf_counter()
    rows, arrays = work()
    # As text: errors may be infinite, which an archive's own JSON may not be.
    text = json.dumps(rows, default=lambda number: number.item())
    if hosts.is_main_process():
        path.parent.mkdir(parents=True, exist_ok=True)
        save_archive(path, JOB_FORMAT, {"rows": text, "seconds": time.perf_counter() - began}, arrays)
    return json.loads(text), arrays


def summary(states: FitState) -> str:
    epochs, best = states.epoch, states.best_mse.min()
    runs, least, most = f"{len(epochs)} run{'s' * (len(epochs) > 1)}", epochs.min(), epochs.max()
    return f"{runs}, {least if least == most else f'{least} to {most}'} epochs, best validation loss {best:.3g}"


def _stem(name: str) -> str:
    return re.sub(r"[^\w.,=-]+", "-", name)  # as a file may be called anywhere


def _identity(states: FitState, plans: RunConfig, settings: Settings, data: Dataset) -> str:
    regulariser = None if settings.regulariser is None else settings.regulariser.__name__
    shared = [settings.batch_size, regulariser, type(settings.solver).__name__]
    objective: Any = settings.objective
    if not isinstance(objective, TrajectoryLoss):
        shared += [type(objective).__name__, asdict(objective)]
    # Array leaves do not include a field's static data, such as the vehicle or the scaling of inputs.
    fixed = [RECIPE, *shared, describe(states.field), content_hash(data)]
    return digest(fixed, named_leaves({"start": states, "plan": plans}))
