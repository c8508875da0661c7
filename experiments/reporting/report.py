"""What an experiment leaves in its folder: report.json, rows.csv and report.md, and the same in a terminal."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from experiments.reporting import claims
from experiments.reporting.claims import Verdict
from experiments.reporting.results import Results
from experiments.reporting.tables import Table, markdown, plain, print_tables
from hybrid_jax.io.files import json_text, json_value, read_json, write_whole

FORMAT = 2  # of report.json; 1 had no key "format", and rows of some experiments without all their tags
JSON_NAME, CSV_NAME, PAGE_NAME = "report.json", "rows.csv", "report.md"
_REQUIRED = {"experiment": str, "config": dict, "environment": dict, "rows": list, "claims": list}
_OPTIONAL = {"format": int, "tags": list, "not_judged": list, "figures": dict, "notes": list}


@dataclass(frozen=True)
class Report:
    """One experiment's outcome.

    Attributes:
        experiment: its name.
        config: the configuration as JSON values.
        environment: see `environment`.
        rows: a row per run.
        claims: verdicts on what was to be shown.
        figures: path of a picture relative to the report → its caption.
        notes: sentences for the end of the page.
        extra: further keys of report.json, JSON values.
        head: title and introduction of the page, Markdown.
        tables: of the page and the terminal.
        more_rows: further rows of rows.csv, which report.json holds in `extra`.
    """

    experiment: str
    config: Mapping[str, Any]
    environment: Mapping[str, Any]
    rows: Results
    claims: Sequence[Verdict] = ()
    figures: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    extra: Mapping[str, Any] = field(default_factory=dict)
    head: str = field(default="", compare=False)
    tables: Sequence[Table] = field(default=(), compare=False)
    more_rows: Results = field(default_factory=Results, compare=False)


def write_report(out: str | Path, report: Report, console: Console | None = None) -> None:
    """Write report.json, rows.csv and report.md into the folder `out`, each atomically, report.json last.

    Args:
        console: where to print the tables and the notes, if anywhere.

    Raises:
        ValueError: `extra` takes a key of the report's own, or a value has no JSON form; then nothing was written.
        OSError: the folder cannot be written.
    """
    record = json_text(to_json(report))
    contents = {CSV_NAME: (report.rows + report.more_rows).to_csv(), PAGE_NAME: page(report), JSON_NAME: record}
    for name, content in {name: content.encode() for name, content in contents.items()}.items():
        write_whole(Path(out) / name, content)
    if console is not None:
        print_tables(console, report.tables)
        for note in report.notes:
            console.print(Text(note))


def load_report(path: str | Path) -> Report:
    """Read a report.json, or the one in the folder `path`; its page and tables are not part of it.

    Raises:
        ValueError: the file is missing, not JSON, or not a report; one line that names the file and what is wrong.
    """
    path = Path(path)
    path = path / JSON_NAME if path.is_dir() else path
    record = read_json(path)
    try:
        return from_json(record)
    except ValueError as error:
        raise ValueError(f"{path}: not a report: {error}") from error


def to_json(report: Report) -> dict[str, Any]:
    """The content of report.json.

    Raises:
        ValueError: as `write_report`.
    """
    taken = set(report.extra) & (_REQUIRED.keys() | _OPTIONAL.keys())
    if taken:
        raise ValueError(f"extra must not take the report's own keys, got {', '.join(sorted(taken))}")
    own = {"format": FORMAT, "experiment": report.experiment, "config": report.config}
    own |= {"environment": report.environment, "tags": report.rows.tags, "rows": report.rows.rows}
    own |= claims.to_json(report.claims) | {"figures": report.figures, "notes": report.notes}
    return json_value(own | dict(report.extra))


def from_json(record: Any) -> Report:
    """The report of what `to_json` gave.

    Raises:
        ValueError: a key is missing or of another type, or a row or a claim is malformed; one line.
    """
    if not isinstance(record, dict):
        raise ValueError("the top level must be an object")
    for name, kind in (_REQUIRED | _OPTIONAL).items():
        if name in _REQUIRED and name not in record:
            raise ValueError(f"{name} is missing")
        if name in record and not isinstance(record[name], kind):
            raise ValueError(f"{name} must not be a {type(record[name]).__name__}")
    if record.get("format", FORMAT) > FORMAT:
        raise ValueError(f"format {record['format']} is newer than {FORMAT}, which this version reads")
    figures, notes = record.get("figures", {}), record.get("notes", [])
    if not all(isinstance(text, str) for text in [*figures.values(), *notes]):
        raise ValueError("figures and notes must hold text")
    rows = Results(record["rows"], record.get("tags", []))
    extra = {name: value for name, value in record.items() if name not in _REQUIRED | _OPTIONAL}
    own = (record["experiment"], record["config"], record["environment"], rows)
    return Report(*own, claims.from_json(record), figures, notes, extra)


def page(report: Report) -> str:
    """report.md: head, tables, figures, notes, environment and configuration."""
    parts = [report.head or f"# {report.experiment}"]
    for table in report.tables:
        parts += [f"## {plain(table.title)}", markdown(table)]
    if report.figures:
        captions = {path: plain(caption) for path, caption in report.figures.items()}
        parts += ["## Figures", *(f"![{caption}]({path})\n\n*{caption}*" for path, caption in captions.items())]
    parts += ["## Notes", "\n".join(f"- {plain(note)}" for note in report.notes)] if report.notes else []
    parts += ["## Environment", markdown(Table("", ("", ""), list(_flat(json_value(report.environment)))))]
    config = json.dumps(json_value(report.config), indent=1, ensure_ascii=False)
    return "\n\n".join([*parts, "## Configuration", f"```json\n{config}\n```"]) + "\n"


def _flat(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Nested mappings as lines of a joined name and a value."""
    for name, value in mapping.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}, ")
        else:
            shown = ", ".join(str(item) for item in value) if isinstance(value, list) else str(value)
            yield f"{prefix}{name}" + (" [s]" if prefix == "seconds, " else ""), shown
