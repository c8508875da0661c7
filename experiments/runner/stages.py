"""The stages of an experiment: finished ones are read from the cache, interrupted ones resume, the rest runs."""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import jax
from filelock import FileLock, Timeout
from rich.console import Console

from experiments.reporting.report import Report, write_report
from experiments.reporting.results import Results, Row
from experiments.runner.cache import Cache, sweep_identity
from experiments.runner.checkpoint import Autosave, Checkpoints, DeferredSignals
from experiments.runner.options import Run
from experiments.runner.progress import Line, clock
from experiments.runner.run_record import PACKAGES, record_of, require_same
from hybrid_jax.io.datasets import Dataset, versions
from hybrid_jax.io.files import Arrays, named_leaves, with_leaves
from hybrid_jax.runtime import cores
from hybrid_jax.sweep import Progress, hosts, sweep
from hybrid_jax.training.fitting import FitState, RunConfig
from hybrid_jax.training.objective import Settings

Result = TypeVar("Result")
Found = tuple[Sequence[Row], Arrays]  # of a job: rows, and arrays by name
Job = Callable[[], Found]
Kept = Callable[[str, Mapping[str, Job]], dict[str, Found]]  # `Stages.kept` of some inputs


@dataclass(frozen=True, eq=False)
class Stage:
    """A stage of an experiment, named by `words`; `compile` prepares the programs of `work` while others run."""

    words: tuple[str, ...]
    work: Callable[..., Any]
    needs: tuple["Stage", ...] = ()
    compile: Callable[[], object] | None = None

    @property
    def name(self) -> str:
        return " ".join(self.words)


class Stages:
    """Runs the stages of an experiment, caches their results, and measures their times.

    `saving` is as in `Run`, `fresh` as in `Cache`.
    """

    def __init__(self, folder: Path, console: Console, saving: float = 0.02, fresh: bool = False):
        self._console, self._share, self._cache = console, saving, Cache(folder, self._say, fresh)
        self.seconds: dict[str, float] = {}  # by stage
        self.reused: list[str] = []  # stages that came from the cache
        self._ran = self._saving = 0.0

    def run(self, protocol: Sequence[Stage]) -> dict[Stage, Any]:
        """Run stages in their order and return their results; meanwhile other threads compile later ones.

        Several processes of one run must compile in the same order, so there each stage compiles when it runs.
        """
        results: dict[Stage, Any] = {}
        pool = ThreadPoolExecutor(cores())
        try:
            new = [each for each in protocol if jax.process_count() == 1 and not self._cache.knows(each.name)]
            compiling = {each: pool.submit(each.compile) for each in new if each.compile}
            for stage in protocol:
                wait([compiling[stage]] if stage in compiling else [])  # an error is met again below
                results[stage] = stage.work(*(results[each] for each in stage.needs))
        finally:
            pool.shutdown(cancel_futures=True)
        return results

    def sweep(
        self,
        name: str,
        states: FitState,
        plans: RunConfig,
        settings: Settings,
        data: Dataset,
        min_capacity: tuple[int, int] = (0, 0),
    ) -> FitState:
        """Return the final states of a sweep on a dataset; a second process with the same cache waits for the first.

        Raises:
            OtherRun: the sweep was begun by other versions of the libraries.
            ValueError: the cached result is damaged; the message names the file, so that you can delete it.
            OSError: the state cannot be saved.
        """
        finished = self._cache.path(name, sweep_identity(states, plans, settings, data))
        begun = finished.with_suffix(".begun")
        checkpoints = Checkpoints(begun)

        def look() -> tuple[tuple[bool, float], Arrays]:
            """Whether the sweep is finished, the seconds spent on it, and its states."""
            if (found := self._cache.load(finished)) is not None:
                return (True, found[0]["seconds"]), found[1]
            if (found := checkpoints.load(self._say)) is None:
                return (False, 0.0), named_leaves(states)
            require_same(f"{begun}: was begun with versions", found[0], {"versions": versions(*PACKAGES)})
            return (False, found[0]["seconds"]), found[1]

        with self._alone(name, finished.with_suffix(".lock")):
            if self._cache.fresh and begun.exists() and hosts.is_main_process():
                self._cache.move_aside(begun)
            (done, spent), arrays = hosts.from_first(look)
            states = with_leaves(states, arrays, finished if done else begun)
            if done:
                self.seconds[name] = spent
                self.reused.append(name)
                self._say(f"{name}: {summary(states)}, as found in the cache")
                return states
            if spent:
                at = f"epoch {states.epoch.max()}, after {clock(spent)}"
                self._say(f"{name}: goes on where it was interrupted, at {at}")
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
                    self._cache.save(finished, {"name": name, "seconds": self.seconds[name]}, named_leaves(states))
                    checkpoints.delete()
        self._ran += self.seconds[name] - spent
        self._saving += autosave.saving
        self._say(f"{name}: {summary(states)}, {clock(self.seconds[name])}")
        return states

    def timed(self, name: str, work: Callable[[], Result], doing: str = "") -> Result:
        """Return the result of `work()` and add its time to the stage `name`; `doing` is shown meanwhile.

        The time of a stage within another counts once.
        """
        began, before = time.perf_counter(), sum(self.seconds.values())
        with Line(name, self._console, doing) if doing else nullcontext():
            result = work()
        within = sum(self.seconds.values()) - before
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began - within
        return result

    def parts(self, name: str, jobs: Sequence[Callable[[], Result]]) -> list[Result]:
        """Run jobs in sequence, with progress, as one timed stage."""
        results: list[Result] = []
        with Line(name, self._console, "compiling and solving") as line:
            for job in jobs:
                results.append(self.timed(name, job))
                line.show_parts(len(results), len(jobs))
        return results

    def kept(self, name: str, jobs: Mapping[str, Job], identity: str) -> dict[str, Found]:
        """Return rows and arrays of each job, run by `parts` or cached by name and `identity` (see `identity_of`)."""
        found, missing = dict[str, Found](), dict[str, Job]()
        for job, work in jobs.items():
            path = self._cache.path(f"{name} {job}", identity)
            about, arrays = hosts.from_first(lambda path=path: self._cache.load(path) or (None, {}))
            if about is None:
                missing[job] = partial(self._run_and_save, path, work)
            else:
                self.seconds[name] = self.seconds.get(name, 0.0) + about["seconds"]
                found[job] = json.loads(about["rows"]), arrays
        if found:
            self.reused.append(f"{len(found)} of {len(jobs)} parts of {name}" if missing else name)
        if missing:
            found |= dict(zip(missing, self.parts(name, list(missing.values())), strict=True))
        return {job: found[job] for job in jobs}

    def notes(self) -> list[str]:
        reused = f"Taken from the cache, with the seconds of the run that made them: {', '.join(self.reused)}."
        saved = f"Saving checkpoints took {self._saving / (self._ran or 1):.2%} of the sweeps' time."
        return [reused] * bool(self.reused) + [saved] * bool(self._ran)

    def publish(
        self, name: str, config: Run, rows: Results, report: Callable[..., Report], *notes: str, **more: Any
    ) -> None:
        """Write and print the report of an experiment, in the process that writes; `more` joins its record."""
        if hosts.is_main_process():
            record = record_of(name, config, rows, self.seconds, [*self.notes(), *notes], **more)
            write_report(config.out / name, report(record), Console())

    @contextmanager
    def _alone(self, name: str, path: Path) -> Iterator[None]:
        """Lock a sweep's file, or wait while another process has it."""
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

    def _run_and_save(self, path: Path, work: Job) -> Found:
        began = time.perf_counter()
        rows, arrays = work()
        # As text: errors may be infinite, which an archive's own JSON may not be.
        text = json.dumps(rows, default=lambda number: number.item())
        if hosts.is_main_process():
            self._cache.save(path, {"rows": text, "seconds": time.perf_counter() - began}, arrays)
        return json.loads(text), arrays

    def _say(self, line: str) -> None:
        self._console.print(line, highlight=False, soft_wrap=True)


def rows_of(found: Mapping[str, Found]) -> list[Row]:
    return [row for rows, _ in found.values() for row in rows]


def stages_of(config: Run, console: Console) -> Stages:
    return Stages(config.cache / "stages", console, config.saving, config.fresh)


def summary(states: FitState) -> str:
    epochs, best = states.epoch, states.best_mse.min()
    runs, least, most = f"{len(epochs)} run{'s' * (len(epochs) > 1)}", epochs.min(), epochs.max()
    return f"{runs}, {least if least == most else f'{least} to {most}'} epochs, best validation loss {best:.3g}"
