"""The vehicle changes in the air, and the controller's model adapts: python -m experiments.online"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console

from experiments.online.config import PRESETS, OnlineConfig
from experiments.online.figures import draw
from experiments.online.flights import fly_all
from experiments.online.results import TAGS, GoalEvidence, claims, conclusion, results_of, tables
from experiments.online.timing import step_time
from experiments.reporting.claims import evaluate, verdict_table, with_recorded
from experiments.reporting.report import Report, rows_in
from experiments.reporting.results import Results
from experiments.runner import command
from experiments.runner.cache import identity_of
from experiments.runner.stages import Found, Stages, rows_of, stages_of
from experiments.worlds.world import DT

NAME = "online"


def flown(config: OnlineConfig, world: str, stages: Stages) -> Found:
    run = fly_all(config, world, stages)
    return results_of(run).rows, {"clock": np.array([run.seconds, run.processor_seconds])}


def experiment(config: OnlineConfig, console: Console) -> None:
    stages = stages_of(config, console)
    jobs = {world: partial(flown, config, world, stages) for world in config.worlds}
    described = {name: value for name, value in config.described().items() if name not in ("preset", "worlds")}
    found = stages.kept("flights", jobs, identity_of(described))
    clock = np.sum([arrays["clock"] for _, arrays in found.values()], axis=0).tolist()
    step = step_time(config.hardware("iris"), DT)
    stages.publish(NAME, config, Results(rows_of(found), TAGS), report, step_ms=step, clock=clock)


def report(record: Mapping[str, Any]) -> Report:
    rows, step = rows_in(record), record["step_ms"]
    evidence = GoalEvidence(rows, step, *record.get("clock", (None, None)))
    verdicts = with_recorded(evaluate(claims(record["config"]["changes"]), evidence), record)
    notes = [f"One step of the filter: {step:.3f} ms of processor time on one core, in a compiled loop."]
    made = [verdict_table(verdicts, "Goals"), *tables(rows)]
    return Report(record, draw(rows), made, conclusion(rows), verdicts, notes=notes)


ABOUT = "The vehicle changes in the air. How soon does the controller fly as well as one that knows the change?"
main = partial(command.run, NAME, ABOUT, experiment, presets=PRESETS)

if __name__ == "__main__":
    main()
