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
HEAD = """\
A hybrid that was trained on usual flight of a vehicle adapts by `hj.adapt` to one flight after a change, or after none,
and is tested over 1 s of usual flights after it. Ratio: its test error over the error of the source. Each source (seed)
has flights of its own to learn from, to adapt to (draws) and to test on, so that sources are independent, and shares
have confidence intervals over them. Flights that crash are left out, but for those to adapt to. For some changes other
methods adapt to the same ten seconds:

- **fine_tune**, **l2_sp**: Adam, and Adam with a penalty on the distance from the source's parameters
- **fine_tune_paper**: Adam on 1000 windows of five flights without noise, another flight says when to stop
- **white_box**, **kalman_filter**: physics without a network, with inertia, k, drag, lift, aerodynamic moments and a
  steady force and torque from nominal values, by least squares and by an extended Kalman filter; they need no source
"""

NOISY: dict[str, Any] = ONE_FLIGHT | {"noise_on": "all"}
PRESETS = {
    "paper": WorldsConfig(seeds=3, draws=3, noise_on="all"),
    "quick": preset_like(
        WorldsConfig,
        replace(BOTH_ENDS, **NOISY, seeds=1, draws=4),
        worlds=("iris", "hummingbird"),
        changes=("nothing", "motor_lag", "battery", "reaction_torque", "external_force", "parameter_shift"),
        learn_from=("moving", "hover", "near_ground", "outliers"),
        n_test=WorldsConfig.n_test,
    ),
    "smoke": preset_like(
        WorldsConfig,
        replace(SMOKE, **NOISY),
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
    return Report(record, verdicts.draw(rows), tables, verdicts.conclusion(rows), judged, HEAD)


ABOUT = "Does adaptation to one flight ever make a model worse, in our simulator or in RotorPy?"
main = partial(command.run, NAME, ABOUT, partial(in_each_world, NAME, TAGS, adapted, report), presets=PRESETS)

if __name__ == "__main__":
    main()
