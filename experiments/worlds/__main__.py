"""Is an adapted model ever worse than its source, in our own worlds and others: python -m experiments.worlds"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from experiments.paper.config import BOTH_ENDS, ONE_FLIGHT, SMOKE, preset_like
from experiments.reporting.claims import evaluate, verdict_table
from experiments.reporting.report import Report, rows_in
from experiments.runner import command
from experiments.worlds import verdicts
from experiments.worlds.cases import WorldsConfig, adapted
from experiments.worlds.flights import in_each_world

NAME = "worlds"
TAGS = "world", "change", "flight", "draw", "seed", "method"
PRESETS = {
    "paper": WorldsConfig(seeds=3, draws=3),
    "quick": preset_like(
        WorldsConfig,
        replace(BOTH_ENDS, **ONE_FLIGHT, seeds=1, draws=4),
        worlds=("iris", "hummingbird"),
        changes=("nothing", "motor_lag", "battery", "reaction_torque", "external_force", "parameter_shift"),
        learn_from=("moving", "hover", "near_ground", "outliers"),
        n_test=WorldsConfig.n_test,
    ),
    "smoke": preset_like(
        WorldsConfig,
        replace(SMOKE, **ONE_FLIGHT),
        worlds=("hummingbird",),
        changes=("nothing",),
        learn_from=("short",),
        rivals=(),
        n_test=1,
    ),
}


def report(record: Mapping[str, Any]) -> Report:
    rows = rows_in(record)
    judged = evaluate(verdicts.CLAIMS, rows)
    tables = [verdict_table(judged, "Hypotheses"), *verdicts.tables(rows)]
    return Report(record, verdicts.draw(rows), tables, verdicts.conclusion(rows), judged)


ABOUT = "Does adaptation to one flight ever make a model worse, in our simulator or in RotorPy?"
main = partial(command.run, NAME, ABOUT, partial(in_each_world, NAME, TAGS, adapted, report), presets=PRESETS)

if __name__ == "__main__":
    main()
