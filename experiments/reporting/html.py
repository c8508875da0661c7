"""report.html: the report as one file that needs no network; its tables sort and its figures zoom."""

import base64
import html
import json
import re
from collections.abc import Sequence
from pathlib import Path

from experiments.reporting.contents import Report
from experiments.reporting.results import leaves
from experiments.reporting.tables import Table, best_cells, number_in
from hybrid_jax.io.files import json_text

VERDICTS = {"✓": "holds", "✗": "fails", "– undecided": "undecided"}
UNBROKEN = 28  # characters of a number with its deviation; a longer cell may take several lines
TYPES = {".png": "image/png", ".gif": "image/gif"}
STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #8881; --link: #0072b2; --good: #009e73; --bad: #d55e00 }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 0 auto; padding: 1rem }
h1 { margin-bottom: .2rem } h2 { margin-top: 2rem; font-size: 1.15rem }
.conclusion { border-left: .3rem solid var(--link); background: var(--soft); padding: .6rem 1rem; font-size: 1.1rem }
.warning { border-left: .3rem solid var(--bad); background: var(--soft); padding: .4rem 1rem }
.wide { overflow-x: auto } table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums }
th, td { text-align: left; vertical-align: top; padding: .25rem .7rem; border-bottom: 1px solid var(--line) }
th { cursor: pointer } th:hover { text-decoration: underline }
th[aria-sort=ascending]::after { content: " ↑" } th[aria-sort=descending]::after { content: " ↓" }
td.number, .holds, .fails, .undecided { white-space: nowrap }
.holds { color: var(--good) } .fails { color: var(--bad); font-weight: bold }
figure { margin: 1.5rem 0 } figcaption { font-style: italic }
figure img { max-width: 100%; background: white; cursor: zoom-in }
figure.zoomed { position: fixed; inset: 0; margin: 0; overflow: auto; background: #000c; z-index: 1 }
figure.zoomed img { max-width: none; width: 200%; cursor: zoom-out } figure.zoomed figcaption { color: white }
"""
SCRIPT = """
for (const head of document.querySelectorAll("th")) head.addEventListener("click", () => {
  const column = head.cellIndex, body = head.closest("table").tBodies[0]
  const down = head.getAttribute("aria-sort") === "ascending"
  for (const other of head.parentNode.cells) other.removeAttribute("aria-sort")
  head.setAttribute("aria-sort", down ? "descending" : "ascending")
  const key = row => row.cells[column].dataset.value
  const order = (a, b) => key(a) !== undefined && key(b) !== undefined
    ? (key(a) - key(b)) * (down ? -1 : 1)
    : key(a) !== undefined ? -1 : key(b) !== undefined ? 1
    : row_text(a, column).localeCompare(row_text(b, column)) * (down ? -1 : 1)
  body.append(...[...body.rows].sort(order))
})
const row_text = (row, column) => row.cells[column].textContent
for (const figure of document.querySelectorAll("figure"))
  figure.addEventListener("click", () => figure.classList.toggle("zoomed"))
document.addEventListener("keydown", event => {
  if (event.key === "Escape") for (const one of document.querySelectorAll(".zoomed")) one.classList.remove("zoomed")
})
"""


def document(report: Report, out: Path) -> str:
    """The page; figures are read from `out`."""
    title, _, introduction = (report.head or f"# {report.experiment}").partition("\n")
    name = html.escape(title.lstrip("# "))
    parts = [f"<h1>{name}</h1>"]
    if sentences := report.conclusions():
        parts.append(f'<div class="conclusion">{" ".join(map(html.escape, sentences))}</div>')
    parts += [f'<p class="warning">{html.escape(line)}</p>' for line in report.warnings]
    parts.append(_folded("The question, the models and the measures", _prose(introduction)))
    for table in report.shown():
        shown = _folded(html.escape(table.title), _table(table._replace(title=""))) if table.folded else _table(table)
        parts.append(shown)
    if report.figures:
        parts.append("<h2>Figures</h2>")
        parts += [_figure(out / path, caption) for path, caption in report.figures.items()]
    if report.notes:
        parts += ["<h2>Notes</h2>", _list(report.notes)]
    known = [(key, json.dumps(value, ensure_ascii=False)) for key, value in leaves(report.environment, ", ")]
    parts.append(_folded("Environment", _table(Table("", ("", ""), known))))
    parts.append(_folded("Configuration", f"<pre>{html.escape(json_text(report.config))}</pre>"))
    body = "\n".join(parts)
    head = f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{name}</title>'
    head += '<meta name="viewport" content="width=device-width">'
    head += f'<link rel="icon" href="data:,"><style>{STYLE}</style></head>'  # without an icon a browser asks for one
    return f"{head}<body>\n{body}\n<script>{SCRIPT}</script></body></html>\n"


def _table(table: Table) -> str:
    best = best_cells(table)
    head = "".join(f'<th scope="col">{html.escape(name)}</th>' for name in table.header)
    rows = []
    for i, line in enumerate(table.lines):
        cells = (_cell(text, (i, j) in best) for j, text in enumerate(line))
        rows.append(f"<tr>{''.join(cells)}</tr>")
    title = f"<h2>{html.escape(table.title)}</h2>\n" if table.title else ""
    body = "\n".join(rows)
    return f'{title}<div class="wide"><table><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>'


def _cell(text: str, best: bool) -> str:
    number = number_in(text)
    value = "" if number is None else f' data-value="{number!r}"' + ' class="number"' * (len(text) <= UNBROKEN)
    kind = next((f' class="{name}"' for start, name in VERDICTS.items() if text.startswith(start)), value)
    shown = html.escape(text)
    return f"<td{kind}>{f'<strong>{shown}</strong>' if best else shown}</td>"


def _figure(path: Path, caption: str) -> str:
    if not path.exists():
        return f'<p class="warning">{html.escape(path.name)} is missing.</p>'
    data = base64.b64encode(path.read_bytes()).decode()
    words = html.escape(caption, quote=True)
    image = f'<img alt="{words}" src="data:{TYPES[path.suffix]};base64,{data}">'
    return f"<figure>{image}<figcaption>{words}</figcaption></figure>"


def _prose(text: str) -> str:
    """Paragraphs and lists of Markdown, with **bold**, *emphasis* and `code`."""
    parts = []
    for block in re.split(r"\n\s*\n", text.strip()):
        first, *items = re.split(r"(?:^|\n)- ", block)
        parts += [f"<p>{_inline(first)}</p>"] * bool(first.strip()) + [_list(items, _inline)] * bool(items)
    return "".join(parts)


def _inline(text: str) -> str:
    text = html.escape(" ".join(text.split()))
    for pattern, tag in ((r"\*\*(.+?)\*\*", "strong"), (r"\*(.+?)\*", "em"), (r"`(.+?)`", "code")):
        text = re.sub(pattern, rf"<{tag}>\1</{tag}>", text)
    return text


def _list(items: Sequence[str], inline=html.escape) -> str:
    return f"<ul>{''.join(f'<li>{inline(item)}</li>' for item in items)}</ul>"


def _folded(title: str, content: str) -> str:
    return f"<details><summary>{title}</summary>{content}</details>"
