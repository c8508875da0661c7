"""Partial differential equations from one trajectory: python -m experiments.reaction_diffusion --help"""

from collections.abc import Mapping
from functools import partial
from typing import Any

from rich.console import Console

from experiments.reaction_diffusion import forecast, gray_scott, shifted
from experiments.reaction_diffusion.config import PRESETS, Config
from experiments.reaction_diffusion.figures import draw
from experiments.reaction_diffusion.report import claims, conclusion, tables
from experiments.reporting.claims import evaluate, verdict_table
from experiments.reporting.report import Report, rows_in
from experiments.reporting.results import Results
from experiments.runner import command
from experiments.runner.cache import identity_of
from experiments.runner.stages import stages_of

NAME = "reaction_diffusion"
SELECTIONS = ("preset", "parts", "cases", "shifts", "seeds", "sizes")  # options that say which jobs, not how


def experiment(config: Config, console: Console) -> None:
    stages = stages_of(config, console)
    options = {name: value for name, value in config.described().items() if name not in SELECTIONS}
    kept = partial(stages.kept, identity=identity_of(options))
    rows = []
    if "forecast" in config.parts:
        rows += forecast.study(config, kept)
    if "shifted" in config.parts:
        rows += shifted.study(config, kept)
    if "gray_scott" in config.parts:
        rows += gray_scott.study(config, kept)
    stages.publish(NAME, config, Results(rows), report)


def report(record: Mapping[str, Any]) -> Report:
    rows = rows_in(record)
    verdicts = evaluate(claims(rows), rows)
    made = [verdict_table(verdicts, "Goals, and the paper's claims for a PDE"), *tables(rows)]
    return Report(record, draw(rows), made, conclusion(rows), verdicts)


ABOUT = "A partial differential equation from one trajectory: forecasts, parameters, and adaptation after a change."
main = partial(command.run, NAME, ABOUT, experiment, presets=PRESETS)

if __name__ == "__main__":
    main()
