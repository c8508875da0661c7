"""Sweeps that are worth keeping: each is found in the cache by the hash of all that fixes it, or run."""

import time
from pathlib import Path

from rich.console import Console

from experiments.progress import SweepLine
from hybrid_jax.archive import digest, load_archive, named_leaves, save_archive, with_leaves
from hybrid_jax.datasets import Dataset, content_hash, versions
from hybrid_jax.sweep import sweep
from hybrid_jax.training import FitState, Plan, Settings

FORMAT = "hybrid_jax sweep 1"
RECIPE = 1  # raise it when the same start, plan and data no longer give the same result


class Stages:
    """Runs sweeps once; knows how long each took.

    Args:
        folder: where finished sweeps are kept.
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
        identity = self._identity(states, plans, settings, data)
        path = self._folder / f"{name.replace(' ', '-')}-{identity[:16]}.npz"
        if path.exists():
            metadata, arrays = load_archive(path, FORMAT)
            self.reused.append(name)
            self.seconds[name] = metadata["seconds"]
            self._console.print(f"{name}: {len(plans.n_train)} lanes, as found in the cache", highlight=False)
            return with_leaves(states, arrays, path)
        began = time.perf_counter()
        final = self._sweep(name, states, plans, settings, data)
        self.seconds[name] = time.perf_counter() - began
        about = {"name": name, "seconds": self.seconds[name], "versions": versions("jax", "hybrid_jax")}
        save_archive(path, FORMAT, about, named_leaves(final))
        return final

    def timed(self, name: str, work):
        """The result of work(), its seconds noted under a name."""
        began = time.perf_counter()
        result = work()
        self.seconds[name] = time.perf_counter() - began
        return result

    def _sweep(self, name: str, states: FitState, plans: Plan, settings: Settings, data: Dataset) -> FitState:
        with SweepLine(name, self._console) as line:
            final = sweep(states, plans, data.splits["train"], data.splits["validation"], settings, on_block=line.show)
        self._console.print(f"{name}: {summary(final)}", highlight=False)
        return final

    def _identity(self, states: FitState, plans: Plan, settings: Settings, data: Dataset) -> str:
        regulariser = None if settings.regulariser is None else settings.regulariser.__name__
        fixed = [RECIPE, settings.batch_size, regulariser, type(settings.solver).__name__, content_hash(data)]
        return digest(fixed, named_leaves({"start": states, "plan": plans}))


def summary(final: FitState) -> str:
    """One line about a finished sweep."""
    first, last = final.epoch.min(), final.epoch.max()
    return f"{len(final.epoch)} lanes, {first} to {last} epochs, best validation loss {final.best_mse.min():.3g}"
