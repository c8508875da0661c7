"""The output of an experiment, report.html, report.md, report.json and rows.csv, and in a terminal."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.console import Console
from rich.text import Text

from experiments.reporting import claims
from experiments.reporting.claims import Verdict
from experiments.reporting.plots import save_figures
from experiments.reporting.questions import QUESTIONS, Asked
from experiments.reporting.results import Results, by_column, by_row, leaves
from experiments.reporting.tables import Table, markdown, narrowed, plain, print_table
from hybrid_jax.cli.page import Page, document
from hybrid_jax.cli.page import Table as Cells
from hybrid_jax.io.files import json_value, write_atomic

FORMAT = 3  # of report.json
PRINTED = 5  # lines of a table in a terminal
JSON_NAME, CSV_NAME, PAGE_NAME, HTML_NAME = "report.json", "rows.csv", "report.md", "report.html"
MEANINGLESS = "The smoke preset only shows that everything works: its numbers mean nothing, so no hypothesis is judged."


@dataclass(frozen=True)
class Report:
    """What is said of a record, which `record_of` makes: sentences, tables, and figures with captions by name."""

    record: Mapping[str, Any]
    figures: Mapping[str, tuple[Figure, str]] = field(default_factory=dict)
    tables: Sequence[Table] = ()
    conclusion: Sequence[str] = ()
    claims: Sequence[Verdict] = ()
    head: str = ""  # in place of the one in questions.toml
    notes: Sequence[str] = ()  # that follow from the rows, before those in the record

    @property
    def meaningless(self) -> bool:
        return self.record["config"].get("preset") == "smoke"

    @property
    def asked(self) -> Asked:
        return QUESTIONS.get(self.record["experiment"], Asked(self.record["experiment"]))

    def captions(self) -> dict[str, str]:
        return {f"{name}.png": caption for name, (_, caption) in self.figures.items()}

    def ordered(self) -> list[tuple[str, str]]:
        """Path and caption of each figure, the main one first."""
        return sorted(self.captions().items(), key=lambda figure: figure[0] != self.asked.figure)

    def conclusions(self) -> list[str]:
        return [MEANINGLESS] if self.meaningless else [*self.conclusion, *claims.summary(self.claims)]

    def shown(self) -> list[Table]:
        """The tables of the page; a smoke run has no verdicts."""
        return [table for table in self.tables if not (self.meaningless and table.verdicts)]

    def main(self) -> Table | None:
        """The table of the page that is not folded."""
        plainly = [table for table in self.shown() if not (table.verdicts or table.folded)]
        return next((table for table in plainly if self.asked.table in table.title), next(iter(plainly), None))

    def page(self, folder: Path) -> Page:
        """Lay out question, answer, one figure, one small table and their meaning; the rest is folded."""
        asked, record = self.asked, self.record
        parts = re.split(r"\n\s*\n|\n- ", self.head or asked.head)
        said = [" ".join(re.sub(r"^- |[*`]", "", each).split()) for each in parts]
        found = self.main()
        main = narrowed(found) if found else None
        answer, *more = self.conclusions() or [""]
        tables = [Cells("More results", ("",), [(each,) for each in more])]
        tables += [Cells("The question, the models and the measures", ("",), [(each,) for each in said if each])]
        tables += [_cells(table) for table in self.shown() if table != main]
        for name, each in {"Environment": record["environment"], "Configuration": record["config"]}.items():
            lines = [(key, json.dumps(value, ensure_ascii=False)) for key, value in leaves(each, ", ")]
            tables.append(Cells(name, ("", ""), lines))
        pictures = [(caption, (folder / path).read_bytes()) for path, caption in self.ordered()]
        return Page(
            asked.question,
            answer,
            _cells(main) if main else None,
            pictures,
            asked.meaning,
            details=[table for table in tables if table.lines],
            notes=[*self.notes, *record["notes"]],
        )


def write_report(out: str | Path, report: Report, console: Console | None = None) -> None:
    """Write report.html, report.md, rows.csv and report.json into the folder `out`, each atomically, report.json last.

    A headline, the first lines of the main table and the report's path are printed to the console, if any.
    """
    out, record = Path(out), lines_of(to_json(report))
    save_figures(out, report.figures)
    page = report.page(out)
    contents = {CSV_NAME: rows_in(report.record).to_csv(), PAGE_NAME: markdown_page(page, report)}
    contents |= {HTML_NAME: document(page), JSON_NAME: record}
    for name, content in {name: content.encode() for name, content in contents.items()}.items():
        write_atomic(out / name, content)
    if console is not None:
        console.print(Text(" ".join(report.conclusions()[:1])))
        if (main := report.main()) and not report.meaningless:
            print_table(console, main, PRINTED)
        console.print(Text(f"Report: {out / HTML_NAME}"), soft_wrap=True)


def rows_in(record: Mapping[str, Any]) -> Results:
    return Results(record["rows"], record.get("tags") or ())


def to_json(report: Report) -> dict[str, Any]:
    """Return the values of report.json: rows by column, as names would else take half of it."""
    judged, rows = claims.to_json(report.claims), by_column(report.record["rows"])
    return json_value({"format": FORMAT, **report.record, "rows": rows, **judged, "figures": report.captions()})


def read_record(folder: str | Path) -> dict[str, Any]:
    """Return the record of a report.json, with its verdicts and captions."""
    record = json.loads((Path(folder) / JSON_NAME).read_text("utf-8"))
    return record | {"rows": by_row(record["rows"])}


def lines_of(record: dict[str, Any]) -> str:
    def text(value: Any) -> str:
        return json.dumps(value, separators=(",", ":"), allow_nan=False, ensure_ascii=False)

    def entry(value: Any) -> str:
        return "[\n" + ",\n".join(map(text, value)) + "\n]" if isinstance(value, list) and value else text(value)

    return "{\n" + ",\n".join(f"{text(name)}: {entry(value)}" for name, value in record.items()) + "\n}\n"


def _cells(table: Table) -> Cells:
    return Cells(table.title, table.header, table.lines)


def markdown_page(page: Page, report: Report) -> str:
    """report.md: the same page; folded parts open on a click, in a site and in a forge."""
    figures = [f"![{plain(caption)}]({path})\n\n*{plain(caption)}*" for path, caption in report.ordered()]
    more = {
        each.title: _bullets([line for (line,) in each.lines]) if [*each.header] == [""] else markdown(each)
        for each in page.details
    }
    more |= {"More figures": "\n\n".join(figures[1:]), "Notes": _bullets(page.notes)}
    record, made = report.record, report.record["environment"]
    by = f"made on {made['date'][:10]} with hybrid_jax {made['versions']['hybrid_jax']}"
    parts = [
        f"# {page.question}",
        f"**{plain(page.answer)}**" * bool(page.answer),
        record.get("remark", ""),  # how the run differs from others, or its program from this one
        *figures[:1],
        f"## {plain(page.table.title)}\n\n{markdown(page.table)}" if page.table else "",
        f"## What this means for you\n\n{_bullets(page.meaning)}" if page.meaning else "",
        f"## Details\n\nThis is the report of `experiments.{record['experiment']}`, {by}.",
        *(
            f'<details markdown="1"><summary>{plain(title)}</summary>\n\n{content}\n\n</details>'
            for title, content in more.items()
            if content
        ),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _bullets(lines: Sequence[str]) -> str:
    return "\n".join(f"- {plain(line)}" for line in lines)
