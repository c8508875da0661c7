"""What an experiment leaves in its folder: report.json, rows.csv and report.md, and the same in a terminal."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from experiments.reporting import claims, names
from experiments.reporting.claims import Verdict
from experiments.reporting.results import Results, leaves
from experiments.reporting.tables import Table, markdown, plain, print_tables
from hybrid_jax.io.files import json_text, json_value, read_json, write_atomic
from hybrid_jax.training.fitting import STATUS_NAMES

FORMAT = 2  # of report.json; 1 had no key "format", and rows of some experiments without all their tags
JSON_NAME, CSV_NAME, PAGE_NAME = "report.json", "rows.csv", "report.md"
_REQUIRED = {"experiment": str, "config": dict, "environment": dict, "rows": list, "claims": list}
_KINDS = _REQUIRED | {"format": int, "tags": list, "not_judged": list, "figures": dict, "notes": list}

# The kinds of cells of a row, and columns of several experiments with a rule.
_PAIR = "[low, high]"
_CELLS = {bool: "true or false", int: "a number", float: "a number", str: "text", list: _PAIR}
_COUNT = ("an integer of at least 0", lambda value: type(value) is int and value >= 0)
_ERROR = ("a number of at least 0", lambda value: type(value) in (int, float) and value >= 0)
_NAMES = {
    "domain": ("source", names.PARAMETER_SHIFT, names.EXTERNAL_FORCE),
    "mode": (names.FINE_TUNED, names.TARGET_ONLY, names.SOURCE_ONLY, "scratch", "zero_shot", "nominal"),
    "status": tuple(STATUS_NAMES.values()),
}
_RULES = {
    **dict.fromkeys(("n_train", "seed", "epochs"), _COUNT),
    **dict.fromkeys(("test_mse", "val_mse", "val_loss"), _ERROR),
    **{column: (f"one of {', '.join(known)}", known.__contains__) for column, known in _NAMES.items()},
}


@dataclass(frozen=True)
class Report:
    """One experiment's outcome; mappings and notes are stored as JSON values.

    Attributes:
        figures: path of a picture relative to the report → its caption.
        notes: sentences for the end of the page.
        extra: further keys of report.json.
        head: title and introduction of the page, Markdown.
        tables: of the page and the terminal.
        more_rows: further rows of rows.csv, which report.json holds in `extra`.

    Raises:
        ValueError: a value has no JSON form.
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

    def __post_init__(self):
        for name in ("config", "environment", "figures", "notes", "extra"):
            object.__setattr__(self, name, json_value(getattr(self, name)))


def write_report(out: str | Path, report: Report, console: Console | None = None) -> None:
    """Write report.json, rows.csv and report.md into the folder `out`, each atomically, report.json last.

    Args:
        console: where to print the tables and the notes, if anywhere.
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
    """The content of report.json."""
    if taken := sorted(set(report.extra) & _KINDS.keys()):
        raise ValueError(f"extra must not take the report's own keys, got {', '.join(taken)}")
    own = {"format": FORMAT, "experiment": report.experiment, "config": report.config}
    own |= {"environment": report.environment, "tags": report.rows.tags, "rows": report.rows.rows}
    own |= claims.to_json(report.claims) | {"figures": report.figures, "notes": report.notes}
    return json_value(own | dict(report.extra))


def load_report(path: str | Path) -> Report:
    """Read a report.json, or the one in the folder `path`; its page and tables are not part of it.

    Raises:
        ValueError: the file is missing, not JSON, or not a report; one line that names the file, and the row and field.
    """
    path = Path(path)
    path = path / JSON_NAME if path.is_dir() else path
    record = read_json(path)
    try:
        return _from_json(record)
    except ValueError as error:
        raise ValueError(f"{path}: not a report: {error}") from error


def _from_json(record: Any) -> Report:
    if not isinstance(record, dict):
        raise ValueError("the top level must be an object")
    for name, kind in _KINDS.items():
        if name in _REQUIRED and name not in record:
            raise ValueError(f"{name} is missing")
        if not isinstance(record.get(name, kind()), kind):
            raise ValueError(f"{name} must not be a {type(record[name]).__name__}")
    if record.get("format", FORMAT) > FORMAT:
        raise ValueError(f"format {record['format']} is newer than {FORMAT}, which this version reads")
    figures, notes = record.get("figures", {}), record.get("notes", [])
    if not all(isinstance(text, str) for text in [*figures.values(), *notes]):
        raise ValueError("figures and notes must hold text")
    rows = Results(record["rows"], record.get("tags", []))
    _check_rows(rows)
    extra = {name: value for name, value in record.items() if name not in _KINDS}
    own = (record["experiment"], record["config"], record["environment"], rows)
    return Report(*own, claims.from_json(record), figures, notes, extra)


def _check_rows(rows: Results) -> None:
    """Refuse the first cell that is of another kind than the column's others, or that no run can have."""
    kinds: dict[str, str] = {}
    for index, row in enumerate(rows):
        for name, value in leaves(row, "."):
            if value is None:
                continue
            kind = _CELLS[type(value)]
            expected, allowed = _RULES.get(name, (kinds.setdefault(name, kind), None))
            if kind == _PAIR and "." not in name:
                expected = "an object"
            if not (allowed(value) if allowed else kind == expected):
                raise ValueError(f"rows[{index}]: {name} must be {expected} or null, got {value!r}")


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
    config = json.dumps(report.config, indent=1, ensure_ascii=False)
    parts += ["## Environment", markdown(Table("", ("", ""), lines)), "## Configuration", f"```json\n{config}\n```"]
    return "\n\n".join(parts) + "\n"
