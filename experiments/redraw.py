"""Write committed reports anew from their report.json: python -m experiments.redraw

It takes those in docs/reference, or in the folders that you give. A report is a function of its record, so that neither
its words nor its pictures can be older than the program: a test makes all of them and compares.
"""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from experiments import ablation, changes, comparison, coverage
from experiments.closed_loop import __main__ as closed_loop
from experiments.excitation import __main__ as excitation
from experiments.online import __main__ as online
from experiments.paper import outcome
from experiments.reaction_diffusion import __main__ as reaction_diffusion
from experiments.real_flight import report as real_flight
from experiments.reporting.plots import save_figures
from experiments.reporting.report import JSON_NAME, PAGE_NAME, Report, lines_of, markdown_page, read_record, to_json
from experiments.worlds import __main__ as worlds

REFERENCE = Path(__file__).parents[1] / "docs/reference"
REPORTS: Mapping[str, Callable[[Mapping[str, Any]], Report]] = {
    **{"ablation": ablation.report, "changes": changes.report, "closed_loop": closed_loop.report},
    **{"comparison": comparison.report, "coverage": coverage.report, "excitation": excitation.report},
    **{"external_force": outcome.report, "online": online.report, "param_shift": outcome.report},
    **{"reaction_diffusion": reaction_diffusion.report, "real_flight": real_flight.report, "worlds": worlds.report},
}


def report_of(folder: Path) -> Report:
    record = read_record(folder)
    return REPORTS[record["experiment"]](record)


def written(folder: Path, report: Report) -> dict[str, str]:
    """Return the text of each file of a report, whose figures are in the folder."""
    return {PAGE_NAME: markdown_page(report.page(folder), report), JSON_NAME: lines_of(to_json(report))}


def main() -> None:
    if {"-h", "--help"} & {*sys.argv[1:]}:
        print(__doc__)
        return
    if unknown := [each for each in sys.argv[1:] if not Path(each).is_dir()]:
        sys.exit(f"{__doc__}\nNo such folder: {', '.join(unknown)}")
    for path in sorted(found for folder in sys.argv[1:] or [REFERENCE] for found in Path(folder).rglob(JSON_NAME)):
        report, folder = report_of(path.parent), path.parent
        save_figures(folder, report.figures)
        for name, text in written(folder, report).items():
            (folder / name).write_text(text, "utf-8")
        print(folder)


if __name__ == "__main__":
    main()
