"""The committed reports, and the tables of pages that quote them."""

import json
from functools import cache

from smoke import ROOT

from experiments.reporting.results import Results


@cache
def committed(name):
    """The rows of a report in docs/reference."""
    report = json.loads((ROOT / "docs/reference" / name / "report.json").read_text())
    return Results(report["rows"], report.get("tags", ()))


def lines(page):
    """The lines of all tables of a page, each as its cells without emphasis, by the first cell."""
    rows = [line.split("|")[1:-1] for line in (ROOT / page).read_text().splitlines() if line.startswith("| ")]
    return {first: cells for first, *cells in ([cell.strip(" *") for cell in row] for row in rows)}
