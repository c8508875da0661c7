"""What an experiment leaves in its folder: report.json, rows.csv and report.md, and the same in a terminal."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from experiments.reporting import claims
from experiments.reporting.claims import Verdict
from experiments.reporting.results import Results, leaves
from experiments.reporting.tables import Table, markdown, plain, print_tables
from hybrid_jax.io.files import json_text, json_value, write_atomic

FORMAT = 2  # of report.json; 1 had no key "format", and rows of some experiments without all their tags
JSON_NAME, CSV_NAME, PAGE_NAME = "report.json", "rows.csv", "report.md"


@dataclass(frozen=True)
class Report:
    experiment: str
    config: Mapping[str, Any]
    environment: Mapping[str, Any]
    rows: Results
    claims: Sequence[Verdict] = ()
    figures: Mapping[str, str] = field(default_factory=dict)  # path relative to the report → caption
    notes: Sequence[str] = ()  # sentences for the end of the page
    extra: Mapping[str, Any] = field(default_factory=dict)  # further keys of report.json
    head: str = ""  # title and introduction of the page, Markdown
    tables: Sequence[Table] = ()  # of the page and the terminal
    more_rows: Results = field(default_factory=Results)  # of rows.csv; report.json holds them in `extra`


def write_report(out: str | Path, report: Report, console: Console | None = None) -> None:
    """Write report.json, rows.csv and report.md into the folder `out`, each atomically, report.json last.

    The tables and the notes are printed to the console, if any.
    """
    record = json_text(to_json(report))
    contents = {CSV_NAME: (report.rows + report.more_rows).to_csv(), PAGE_NAME: page(report), JSON_NAME: record}
    for name, content in {name: content.encode() for name, content in contents.items()}.items():
        write_atomic(Path(out) / name, content)
    if console is not None:
        print_tables(console, report.tables)
        for note in report.notes:
            console.print(Text(note))


def to_json(report: Report) -> dict[str, Any]:
    own = {"format": FORMAT, "experiment": report.experiment, "config": report.config}
    own |= {"environment": report.environment, "tags": report.rows.tags, "rows": report.rows.rows}
    own |= claims.to_json(report.claims) | {"figures": report.figures, "notes": report.notes}
    if taken := sorted(report.extra.keys() & own.keys()):
        raise ValueError(f"extra must not take the report's own keys, got {', '.join(taken)}")
    return json_value(own | dict(report.extra))


def page(report: Report) -> str:
    """report.md: head, tables, figures, notes, environment and configuration."""
    parts = [report.head or f"# {report.experiment}"]
    for table in report.tables:
        parts += [f"## {plain(table.title)}", markdown(table)]
    if report.figures:
        captions = {path: plain(caption) for path, caption in report.figures.items()}
        parts += ["## Figures", *(f"![{caption}]({path})\n\n*{caption}*" for path, caption in captions.items())]
    parts += ["## Notes", "\n".join(f"- {plain(note)}" for note in report.notes)] if report.notes else []
    lines = []
    for name, value in leaves(report.environment, ", "):
        shown = ", ".join(str(item) for item in value) if isinstance(value, list) else str(value)
        lines.append((name + (" [s]" if name.startswith("seconds, ") else ""), shown))
    config = f"```json\n{json_text(report.config)}```"
    parts += ["## Environment", markdown(Table("", ("", ""), lines)), "## Configuration", config]
    return "\n\n".join(parts) + "\n"
