"""Results of flown scenarios, kept in the cache so that no flight is simulated twice."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from experiments.closed_loop.rows import NUMBERS, TAGS, Agent
from experiments.closed_loop.runner import CALL_EVERY, DRAW_EVERY, ClosedLoopRunner
from experiments.closed_loop.scenarios import Scenario
from experiments.reporting.results import Results
from experiments.runner.progress import clock
from hybrid_jax.control import Controller
from hybrid_jax.io.archive import Arrays, digest, load_archive, named_leaves, save_archive
from hybrid_jax.io.datasets import versions
from hybrid_jax.io.files import backup_path
from hybrid_jax.io.models import describe
from hybrid_jax.sweep import hosts

FORMAT = "hybrid_jax closed loop 1"
RECIPE = 7  # raise it when the same flights give other numbers
MADE_BY = ("jax", "hybrid_jax")


@dataclass(frozen=True)
class Flown:
    """The results of a scenario."""

    scenario: Scenario
    arrays: Arrays  # by name, one value per flight; see `runner.simulate`
    seconds: float  # wall-clock time of the simulation, without compiling
    processor_seconds: float  # on all cores
    devices: int  # number of them

    def rows(self) -> list[dict[str, Any]]:
        """One row per flight: its tags and NUMBERS."""
        place = {"reference": self.scenario.reference, "distance": self.scenario.distance}
        return [
            {"domain": self.scenario.domain.name, **asdict(agent), **place, "seed": seed}
            | {name: float(self.arrays[name][i].mean()) for name in NUMBERS}
            | {"crashed": bool(self.arrays["crashed"][i])}
            for i, (agent, seed) in enumerate(self.scenario.keys())
        ]

    def states(self, agent: Agent, seed: int = 0) -> np.ndarray:
        """The states of one flight, every `DRAW_EVERY` periods."""
        return self.arrays["states"][self.scenario.keys().index((agent, seed))]


def results_of(scenarios: Sequence[Flown]) -> Results:
    """The rows of all flights."""
    return Results([row for each in scenarios for row in each.rows()], TAGS)


def flown(
    scenarios: list[Scenario], controller: Controller, seconds: float, folder: Path, console: Console, fresh: bool
) -> list[Flown]:
    """The results of all scenarios in flights of so many seconds, found in the cache `folder` or flown now.

    Args:
        fresh: move results of other versions aside and fly again.

    Raises:
        ValueError: a cached file is damaged; names the file.
    """
    runner = ClosedLoopRunner(controller, seconds, scenarios)
    found = []
    for scenario in scenarios:
        path = folder / f"{scenario.name.replace(' ', '-')}-{_identity(scenario, controller, runner.shared)[:16]}.npz"
        about, arrays = hosts.from_first(lambda path=path: _cached(path, console, fresh))
        origin = "as found in the cache"
        if about is None:
            arrays, spent = runner.fly(scenario)
            about = spent | {"devices": jax.device_count(), "versions": versions(*MADE_BY)}
            origin = clock(about["seconds"])
            if hosts.is_main_process():
                save_archive(path, FORMAT, about, arrays)
        console.print(f"{scenario.name}: {len(scenario.keys())} flights, {origin}", highlight=False, soft_wrap=True)
        found.append(Flown(scenario, arrays, *(about[name] for name in ("seconds", "processor_seconds", "devices"))))
    return found


def _identity(scenario: Scenario, controller: Controller, shared: tuple) -> str:
    models = list(scenario.models.values())
    fixed = [RECIPE, CALL_EVERY, DRAW_EVERY, asdict(controller), *map(describe, models)]
    flights = [flight._replace(model=None) for flight in scenario.flights()]
    return digest(fixed, named_leaves({"flights": flights, "models": models, "shared": shared}))


def _cached(path: Path, console: Console, fresh: bool) -> tuple[dict[str, Any] | None, Arrays]:
    if not path.exists():
        return None, {}
    about, arrays = load_archive(path, FORMAT)
    if fresh and about["versions"] != versions(*MADE_BY):
        backup = path.rename(backup_path(path, "before"))
        console.print(f"{path}: moved aside to {backup.name}", highlight=False)
        return None, {}
    return about, arrays
