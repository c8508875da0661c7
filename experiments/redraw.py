"""Draw the figures of committed reports anew from what their report.json keeps: python -m experiments.redraw

docs/reference is redrawn, or the folders that you give. Every figure is a function of report.json only, so that a
picture cannot be older than its program: a test draws all of them and compares.
"""

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from experiments import ablation, changes, comparison, coverage
from experiments.closed_loop import figures as closed_loop
from experiments.excitation import results as excitation
from experiments.online import figures as online
from experiments.paper import outcome
from experiments.reaction_diffusion import figures as reaction_diffusion
from experiments.real_flight import report as real_flight
from experiments.reporting.plots import save_figures
from experiments.reporting.report import JSON_NAME
from experiments.reporting.results import Results
from experiments.worlds import verdicts as worlds

REFERENCE = Path(__file__).parents[1] / "docs/reference"
Drawn = dict[str, tuple[Figure, str]]  # figure and caption by name
DRAWN: Mapping[str, Callable[[Results, Mapping[str, Any]], Drawn]] = {
    "ablation": lambda rows, _: ablation.draw(rows),
    "changes": lambda rows, _: changes.draw(rows),
    "closed_loop": lambda rows, _: closed_loop.draw(rows),
    "comparison": lambda rows, record: comparison.draw(rows, record[outcome.FLOOR]),
    "coverage": lambda rows, _: coverage.draw(rows),
    "excitation": lambda rows, _: excitation.draw(rows),
    "external_force": outcome.draw,
    "online": lambda rows, _: online.draw(rows),
    "param_shift": outcome.draw,
    "reaction_diffusion": lambda rows, _: reaction_diffusion.draw(rows),
    "real_flight": lambda rows, _: real_flight.draw(rows),
    "worlds": lambda rows, _: worlds.draw(rows),
}


def drawn(folder: Path) -> Drawn:
    """Draw the figures of the report in a folder; none if it has none."""
    record = json.loads((folder / JSON_NAME).read_text())
    draw = DRAWN.get(record["experiment"], lambda *_: {})
    return draw(Results(record["rows"], record.get("tags") or ()), record)


def main() -> None:
    for path in sorted(found for folder in sys.argv[1:] or [REFERENCE] for found in Path(folder).rglob(JSON_NAME)):
        for name in save_figures(path.parent, drawn(path.parent)):
            print(path.parent / name)


if __name__ == "__main__":
    main()
