"""What an experiment leaves behind: report.json, rows.csv and report.md, and the same in a terminal."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from experiments.paper.claims import COMPARISON, Claim
from experiments.paper.rows import DOMAIN_OF, DOMAINS, THETA, Row, check_unique, row_from, to_csv
from experiments.paper.standings import standings
from experiments.reporting.report_page import page
from experiments.reporting.report_tables import Table, headline, lane_notes, parameters, verdicts
from hybrid_jax.io.files import json_text, json_value, read_json, write_atomic

JSON_NAME, CSV_NAME, PAGE_NAME = "report.json", "rows.csv", "report.md"
FLOOR = "wind_sine_mse"  # key of `extra`: the share of L^T_MSE that is the wind's sine
HEADLINES = {COMPARISON: standings}  # of the experiments that have others than `headline`
_REQUIRED = {"experiment": str, "config": dict, "environment": dict, "rows": list, "claims": list}
_OPTIONAL = {"not_judged": list, "truth_theta": dict | None, "figures": dict, "notes": list}


@dataclass(frozen=True)
class Report:
    """One experiment's outcome.

    Attributes:
        experiment: "param_shift", "external_force", "comparison", or a name of one's own.
        config: the configuration as JSON values.
        environment: see `experiments.reporting.environment.environment`.
        rows: one per trained model.
        claims: see `experiments.paper.claims.claims`.
        truth_theta: the target vehicle's Ix, Iy [kg m²], k [N/(rad/s)²], if known; by domain where there are several.
        figures: path of a picture relative to the report → its caption.
        notes: further sentences for the page.
        extra: further keys of report.json, JSON values; the one called FLOOR makes a note as well.
    """

    experiment: str
    config: Mapping[str, Any]
    environment: Mapping[str, Any]
    rows: Sequence[Row]
    claims: Sequence[Claim]
    truth_theta: Mapping[str, Any] | None = None
    figures: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    extra: Mapping[str, Any] = field(default_factory=dict)


def write_report(out: str | Path, report: Report) -> None:
    """Write report.json, rows.csv and report.md into the folder `out`, each whole or not at all, report.json last.

    Raises:
        ValueError: a row stands twice, `extra` takes a key that is the report's own, or a value has no JSON form; then
            nothing was written.
        OSError: the folder cannot be written.
    """
    out = Path(out)
    record = json_text(to_record(report))
    text = page(report_tables(report), **_page_parts(report))
    contents = {CSV_NAME: to_csv(report.rows), PAGE_NAME: text, JSON_NAME: record}
    for name, content in {name: content.encode() for name, content in contents.items()}.items():
        write_atomic(out / name, content)


def load_report(path: str | Path) -> Report:
    """Read a report.json, or the one in the folder `path`, and check it.

    Raises:
        ValueError: the file is missing, not JSON, or not a report; one line that names the file and what is wrong.
    """
    path = Path(path)
    path = path / JSON_NAME if path.is_dir() else path
    record = read_json(path)
    try:
        return from_record(record)
    except ValueError as error:
        raise ValueError(f"{path}: not a report: {error}") from error


def to_record(report: Report) -> dict[str, Any]:
    """The report as JSON values: claims without a verdict stand apart, under `not_judged`.

    Raises:
        ValueError: as `write_report`.
    """
    taken = set(report.extra) & (_REQUIRED.keys() | _OPTIONAL.keys())
    if taken:
        raise ValueError(f"extra must not take the report's own keys, got {', '.join(sorted(taken))}")
    own = {
        "experiment": report.experiment,
        "config": report.config,
        "environment": report.environment,
        "rows": [asdict(row) for row in check_unique(report.rows)],
        "claims": [asdict(claim) for claim in report.claims if claim.holds is not None],
        "not_judged": [_unjudged(claim) for claim in report.claims if claim.holds is None],
        "truth_theta": report.truth_theta,
        "figures": report.figures,
        "notes": list(report.notes),
    }
    return json_value(own | dict(report.extra))


def from_record(record: Any) -> Report:
    """The report of JSON values.

    Raises:
        ValueError: a key is missing or of another type, or a row, a claim or the true θ_p is malformed; one line.
    """
    if not isinstance(record, dict):
        raise ValueError("the top level must be an object")
    for name, kind in (_REQUIRED | _OPTIONAL).items():
        if name in _REQUIRED and name not in record:
            raise ValueError(f"{name} is missing")
        if name in record and not isinstance(record[name], kind):
            raise ValueError(f"{name} must not be a {type(record[name]).__name__}")
    rows = check_unique(_each("rows", record["rows"], lambda item: row_from(_placed(item, record["experiment"]))))
    judged = _each("claims", record["claims"], _claim)
    apart = _each("not_judged", record.get("not_judged", []), lambda item: _claim(_as_claim(item)))
    optional = {name: record[name] for name in ("figures", "notes", "truth_theta") if name in record}
    extra = {name: value for name, value in record.items() if name not in _REQUIRED and name not in _OPTIONAL}
    # Claims keep the order of their numbers, whichever of the two lists a claim came from.
    claims = sorted(judged + apart, key=lambda claim: (len(claim.id), claim.id))
    own = (record["experiment"], record["config"], record["environment"])
    return _check_optional(Report(*own, rows, claims, extra=extra, **optional))


def report_tables(report: Report) -> list[Table]:
    """The headline tables, the claims and, where there are any, the parameters."""
    tables = HEADLINES.get(report.experiment, headline)
    return [*tables(report.rows), verdicts(report.claims), *parameters(report.rows, report.truth_theta)]


def print_report(console: Console, report: Report) -> None:
    """Print the headline tables, the claims and what went wrong."""
    print_tables(console, report_tables(report))
    for note in _notes(report):
        console.print(Text(note))


def print_tables(console: Console, tables: Sequence[Table]) -> None:
    """Print tables as a terminal shows them best."""
    for table in tables:
        # As Text, or the brackets of a unit would be read as markup.
        printed = RichTable(title=Text(table.title), title_justify="left")
        for name in table.header:
            printed.add_column(Text(name), overflow="fold")
        for line in table.lines:
            printed.add_row(*(_coloured(cell) for cell in line))
        console.print(printed)


def _coloured(cell: str) -> Text:
    return Text(cell, style={"✓ holds": "green", "✗ fails": "bold red"}.get(cell, ""))


def _page_parts(report: Report) -> dict[str, Any]:
    return {
        "experiment": report.experiment,
        "rows": report.rows,
        "figures": report.figures,
        "environment": json_value(report.environment),
        "config": json.dumps(json_value(report.config), indent=1, ensure_ascii=False),
        "notes": _notes(report),
    }


def _notes(report: Report) -> list[str]:
    floor = report.extra.get(FLOOR)
    notes = [*lane_notes(report.rows), *report.notes]
    if _is_number(floor):
        notes.append(f"About {floor:.2e} of a test error in the wind is its sine: no model without a clock sees it.")
    return notes


def _each(name: str, items: list, read) -> list:
    found = []
    for index, item in enumerate(items):
        try:
            found.append(read(item))
        except ValueError as error:
            raise ValueError(f"{name}[{index}]: {error}") from error
    return found


def _placed(item: Any, experiment: str) -> Any:
    """A row of the time when a report had only the one domain of its experiment, with this domain."""
    domain = DOMAIN_OF.get(experiment)
    return item if domain is None or not isinstance(item, dict) else {"domain": domain} | item


def _claim(item: Any) -> Claim:
    kinds = {"id": str, "text": str, "holds": bool | None, "measured": str}
    if not isinstance(item, dict) or set(item) != set(kinds):
        raise ValueError("a claim must be an object of id, text, holds, measured")
    if not all(isinstance(item[name], kind) for name, kind in kinds.items()):
        raise ValueError("a claim's holds must be true or false and the rest text")
    return Claim(**item)


def _unjudged(claim: Claim) -> dict[str, str]:
    return {"id": claim.id, "text": claim.text, "why": claim.measured}


def _as_claim(item: Any) -> dict[str, Any]:
    if not isinstance(item, dict) or not {"id", "why"} <= set(item):
        raise ValueError("must be an object of id, text, why")
    return {"id": item["id"], "text": item.get("text", ""), "holds": None, "measured": item["why"]}


def _check_optional(report: Report) -> Report:
    if not all(isinstance(text, str) for text in [*report.figures.values(), *report.notes]):
        raise ValueError("figures and notes must hold text")
    truth = report.truth_theta
    if truth is not None:
        several = bool(truth) and set(truth) <= set(DOMAINS)
        for theta in truth.values() if several else [truth]:
            _check_truth(theta)
    return report


def _check_truth(theta: Any) -> None:
    if not isinstance(theta, dict) or set(theta) != set(THETA):
        raise ValueError(f"truth_theta must hold exactly {', '.join(THETA)}, or these by domain")
    if not all(_is_number(value) for value in theta.values()):
        raise ValueError("truth_theta must hold numbers other than 0")


def _is_number(value: Any) -> bool:
    return isinstance(value, float) and math.isfinite(value) and value != 0
