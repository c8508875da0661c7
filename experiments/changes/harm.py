"""Is an adapted model ever worse than its source, in our own worlds and others: python -m experiments.changes.harm"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from experiments.changes import verdicts
from experiments.changes.cases import HarmConfig, adapted
from experiments.paper.config import BOTH_ENDS, ONE_FLIGHT, SMOKE, preset_like
from experiments.reporting.claims import evaluate, verdict_table
from experiments.reporting.report import Report, rows_in
from experiments.runner import command
from experiments.worlds.flights import in_each_world
from experiments.worlds.world import NOTHING

NAME = "changes.harm"
TAGS = "world", "change", "flight", "draw", "seed", "method"
# Sources learn from less flight than in the paper, so that there can be twelve in each world.
MANY = replace(BOTH_ENDS, **ONE_FLIGHT, preset="paper", seeds=12, draws=3, n_test=HarmConfig.n_test)
ONE = replace(SMOKE, **ONE_FLIGHT, n_test=1)
PRESETS = {
    "paper": preset_like(HarmConfig, MANY, data_seed=33),  # flights that were not seen when rules were chosen
    "quick": preset_like(HarmConfig, MANY, preset="quick", seeds=1, draws=4, worlds=("iris", "hummingbird")),
    "smoke": preset_like(HarmConfig, ONE, worlds=("hummingbird",), changes=(NOTHING,), learn_from=("short",)),
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
