"""Write committed reports anew from their report.json: python -m experiments.redraw

It takes those in docs/reference, or in the folders that you give. A report is a function of its record, so that neither
its words nor its pictures can be older than the program: a test makes all of them and compares.
"""

import sys
from importlib import import_module
from pathlib import Path

from experiments.reporting.plots import save_figures
from experiments.reporting.report import JSON_NAME, PAGE_NAME, Report, lines_of, markdown_page, read_record, to_json

REFERENCE = Path(__file__).parents[1] / "docs/reference"
# Modules with the `report` of an experiment, if it is not in the one that you run.
ELSEWHERE = {"param_shift": "paper.outcome", "external_force": "paper.outcome", "real_flight": "real_flight.report"}


def report_of(folder: Path) -> Report:
    record = read_record(folder)
    module = import_module(f"experiments.{ELSEWHERE.get(record['experiment'], record['experiment'])}")
    if hasattr(module, "__path__"):  # a package
        module = import_module(f"{module.__name__}.__main__")
    return module.report(record)


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
