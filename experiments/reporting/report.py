"""What an experiment leaves in its folder, report.html, report.md, report.json and rows.csv, and in a terminal."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from experiments.reporting import claims, latex
from experiments.reporting.contents import Report
from experiments.reporting.results import leaves
from experiments.reporting.tables import Table, markdown, plain, print_tables
from hybrid_jax.cli.page import Page, document
from hybrid_jax.cli.page import Table as Cells
from hybrid_jax.io.files import json_text, json_value, write_atomic

FORMAT = 2  # of report.json; 1 had no key "format", and rows of some experiments without all their tags
JSON_NAME, CSV_NAME, PAGE_NAME, HTML_NAME = "report.json", "rows.csv", "report.md", "report.html"
PAPER = "paper"  # the subfolder of LaTeX tables


def write_report(out: str | Path, report: Report, console: Console | None = None, paper: bool = False) -> None:
    """Write report.html, report.md, rows.csv and report.json into the folder `out`, each atomically, report.json last.

    The tables, the notes and where the report is are printed to the console, if any. `paper`: also LaTeX tables.
    """
    out, record = Path(out), lines_of(to_json(report))
    tables = {f"{PAPER}/{latex.file_name(table)}.tex": latex.latex(table) for table in report.shown() if paper}
    contents = {CSV_NAME: (report.rows + report.more_rows).to_csv(), PAGE_NAME: page(report)} | tables
    contents |= {HTML_NAME: document(shown_page(report, out)), JSON_NAME: record}
    for name, content in {name: content.encode() for name, content in contents.items()}.items():
        write_atomic(out / name, content)
    if console is not None:
        print_tables(console, report.printed())
        for line in (*report.notes, *report.warnings, *report.conclusions()):
            console.print(Text(line))
        console.print(Text(f"Report: {out / HTML_NAME}"), soft_wrap=True)


def to_json(report: Report) -> dict[str, Any]:
    own = {"format": FORMAT, "experiment": report.experiment, "config": report.config}
    own |= {"environment": report.environment, "tags": report.rows.tags, "rows": report.rows.rows}
    own |= claims.to_json(report.claims) | {"figures": report.figures, "notes": report.notes}
    if taken := sorted(report.extra.keys() & own.keys()):
        raise ValueError(f"extra must not take the report's own keys, got {', '.join(taken)}")
    return json_value(own | dict(report.extra))


def lines_of(record: dict[str, Any]) -> str:
    """JSON with a line for each row."""

    def text(value: Any) -> str:
        return json.dumps(value, separators=(",", ":"), allow_nan=False, ensure_ascii=False)

    def entry(value: Any) -> str:
        return "[\n" + ",\n".join(map(text, value)) + "\n]" if isinstance(value, list) and value else text(value)

    return "{\n" + ",\n".join(f"{text(name)}: {entry(value)}" for name, value in record.items()) + "\n}\n"


def shown_page(report: Report, out: Path) -> Page:
    """report.html as the console script writes its pages; figures are read from `out`."""
    _, _, introduction = report.head.partition("\n")
    said = [" ".join(re.sub(r"[*`]", "", each).split()) for each in re.split(r"\n\s*\n|(?:^|\n)- ", introduction)]
    main, tables = report.main_table(), [_cells(table) for table in report.folded_tables()]
    about = {"Environment": report.environment, "Configuration": report.config}
    known = [
        Cells(name, ("", ""), [(key, json.dumps(value, ensure_ascii=False)) for key, value in leaves(each, ", ")])
        for name, each in about.items()
    ]
    asked = Cells("The question, the models and the measures", ("",), [(each,) for each in said if each])
    return Page(
        report.asked.question,
        " ".join(report.conclusions()),
        _cells(main) if main else None,
        [(caption, (out / path).read_bytes()) for path, caption in report.figures_in_order().items()],
        [*report.warnings, *report.asked.meaning],
        details=[*([asked] if asked.lines else []), *tables, *known],
        notes=report.notes,
    )


def _cells(table: Table) -> Cells:
    return Cells(table.title, table.header, table.lines)


def page(report: Report) -> str:
    """report.md: question, answer, one figure, one table and what they mean; the rest is folded."""
    _, _, introduction = report.head.partition("\n")
    figures = [f"![{plain(text)}]({path})\n\n*{plain(text)}*" for path, text in report.figures_in_order().items()]
    answer, main = " ".join(map(plain, report.conclusions())), report.main_table()
    parts = [
        f"# {report.asked.question}",
        f"**{answer}**" if answer else "",
        *map(plain, report.warnings),
        *figures[:1],
    ]
    parts += [f"## {plain(main.title)}", markdown(main)] if main else []
    parts += ["## What this means for you", bullets(report.asked.meaning)] if report.asked.meaning else []
    parts += ["## Details", f"This is the report of `experiments.{report.experiment}`."]
    parts += [folded("Question, models and measures", introduction.strip())] if introduction.strip() else []
    parts += [folded(plain(table.title), markdown(table)) for table in report.folded_tables()]
    parts += [folded("More figures", "\n\n".join(figures[1:]))] if figures[1:] else []
    parts += [folded("Notes", bullets(report.notes))] if report.notes else []
    lines = []
    for name, value in leaves(report.environment, ", "):
        shown = ", ".join(str(item) for item in value) if isinstance(value, list) else str(value)
        lines.append((name + (" [s]" if name.startswith("seconds, ") else ""), shown))
    config = f"```json\n{json_text(report.config)}```"
    parts += [folded("Environment", markdown(Table("", ("", ""), lines))), folded("Configuration", config)]
    return "\n\n".join(part for part in parts if part) + "\n"


def bullets(lines: Sequence[str]) -> str:
    return "\n".join(f"- {plain(line)}" for line in lines)


def folded(title: str, content: str) -> str:
    """Markdown that opens on a click, in a site and in a forge."""
    return f'<details markdown="1"><summary>{title}</summary>\n\n{content}\n\n</details>'
