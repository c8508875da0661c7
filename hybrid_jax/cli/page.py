"""The report of a verb: report.html, a single self-contained file, and report.json with stable keys."""

import base64
import io
import re
import sys
import textwrap
from collections.abc import Sequence, Sized
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.figure import Figure

from hybrid_jax.cli.command import printable
from hybrid_jax.io.files import json_text, json_value, write_atomic

WIDTH, ROWS = 80, 5  # columns and rows on a terminal
FORMAT = 1  # of report.json
STYLE: dict[Any, Any] = {"axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.3}
# Okabe and Ito's colours, which colour-blind readers can distinguish.
CYCLE = "cycler('color', ['#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '0.3'])"
STYLE |= {"legend.frameon": False, "font.size": 9, "axes.titlesize": 9, "axes.prop_cycle": CYCLE}
CSS = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 56rem; margin: 0 auto; padding: 1rem; color: #1a1a1a }
h1 { font-size: 1.3rem } h2 { font-size: 1.1rem } .answer { font-size: 1.2rem; font-weight: 600 }
h1, p { overflow-wrap: anywhere }
.scroll { overflow-x: auto } table { border-collapse: collapse; font-size: .9rem }
td, th { padding: .25rem .6rem; text-align: left; border-bottom: 1px solid #ddd; vertical-align: top }
@media (max-width: 30rem) { body { padding: .5rem } table { font-size: .8rem } td, th { padding: .25rem .3rem } }
figure { margin: 1rem 0 } img { max-width: min(100%, 40rem) } figcaption { font-size: .9rem; color: #555 }
details { margin: .5rem 0 } summary { cursor: pointer } li { overflow-wrap: anywhere }
@media (prefers-color-scheme: dark) { body { background: #161616; color: #e6e6e6 } td, th { border-color: #444 }
img { filter: invert(1) hue-rotate(180deg); mix-blend-mode: screen } figcaption { color: #aaa } }
"""


class Table(NamedTuple):
    title: str
    header: Sequence[str]
    lines: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Page:
    """The contents of a report, in reading order."""

    question: str  # that the verb answers
    answer: str  # in a sentence
    table: Table | None = None  # of a few rows
    figures: Sequence[tuple[str, Figure | bytes]] = ()  # captions and figures or GIFs; the first is not folded
    meaning: Sequence[str] = ()  # sentences that interpret the answer
    todo: Sequence[str] = ()  # sentences on what you should do next
    details: Sequence[Table] = ()  # folded
    notes: Sequence[str] = ()  # folded lines


def counted(several: Sized, what: str) -> str:
    """Return, for example, "1 log" or "2 logs"."""
    return f"{len(several)} {what}{'s' * (len(several) != 1)}"


def write(out: Path, verb: str, page: Page, found: dict[str, Any]) -> None:
    """Write report.html and report.json (`found`, for programs) into a folder; print the answer and the path."""
    record = {"format": FORMAT, "verb": verb, "answer": page.answer, "notes": list(page.notes)} | found
    write_atomic(out / "report.json", json_text(json_value(record)).encode())
    write_atomic(out / "report.html", document(page).encode())
    rows = _rows(page.table) if page.table and verb != "inspect" else []  # `inspect` has printed its lines
    lines = page.answer, *rows, *(f"- {line}" for line in (*page.meaning, *page.todo)), f"page: {out / 'report.html'}"
    for line in lines:
        say(line)


def say(line: str) -> None:
    """Print a line, on a terminal in whole words of `WIDTH` columns."""
    line = printable(line)
    print(textwrap.fill(line, WIDTH, subsequent_indent="  ") if sys.stdout.isatty() else line)


def _rows(table: Table) -> list[str]:
    """Return a table's title, header and first rows, with as many columns as a terminal has room for."""
    rows = [table.header, *table.lines[:ROWS]]
    widths = [max(len(str(cell)) for cell in column) + 2 for column in zip(*rows, strict=True)]
    while sum(widths) > WIDTH - 2:
        widths.pop()
    texts = ("".join(f"{cell!s:{width}}" for cell, width in zip(row, widths, strict=False)) for row in rows)
    return [f"{table.title}:", *(f"  {text.rstrip()}" for text in texts)]


def document(page: Page) -> str:
    first, *others = [_figure(*each) for each in page.figures] or [""]
    parts = [f"<h1>{escape(page.question)}</h1><p class=answer>{escape(page.answer)}</p>", first]
    parts += [_table(page.table)] if page.table else []
    for title, lines in (("What it means", page.meaning), ("What to do next", page.todo)):
        parts += [f"<h2>{title}</h2>{_list(lines)}"] if lines else []
    parts += [_folded(table.title, _table(table._replace(title=""))) for table in page.details]
    parts += [_folded("More pictures", "".join(others))] if others else []
    parts += [_folded("Notes", _list(page.notes))] if page.notes else []
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    head += '<link rel="icon" href="data:,">'  # otherwise a browser requests one
    title = f"<title>{escape(page.question)}</title><style>{CSS}</style>"
    return f'<!doctype html><html lang="en"><head>{head}{title}</head><body>{"".join(parts)}</body></html>\n'


def _figure(caption: str, figure: Figure | bytes) -> str:
    data = io.BytesIO(figure if isinstance(figure, bytes) else b"")
    if isinstance(figure, Figure):
        with mpl.rc_context(STYLE):
            figure.savefig(data, format="png", dpi=160)
    kind = "gif" if data.getvalue().startswith(b"GIF") else "png"
    text = base64.b64encode(data.getvalue()).decode()
    picture = f'<img alt="{escape(caption)}" src="data:image/{kind};base64,{text}">'
    return f"<figure>{picture}<figcaption>{escape(caption)}</figcaption></figure>"


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(str(cell))}</th>" for cell in table.header)
    body = "".join(f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in line)}</tr>" for line in table.lines)
    title = f"<h2>{escape(table.title)}</h2>" if table.title else ""
    return f"{title}<div class=scroll><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _list(lines: Sequence[str]) -> str:
    items = (re.sub("`([^`]*)`", r"<code>\1</code>", escape(line)) for line in lines)
    return f"<ul>{''.join(f'<li>{item}</li>' for item in items)}</ul>"


def _folded(title: str, content: str) -> str:
    return f"<details><summary>{escape(title)}</summary>{content}</details>"
