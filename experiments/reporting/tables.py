"""Tables of text, the same for a page and for a terminal."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from experiments.reporting import names
from experiments.reporting.results import Results
from experiments.reporting.statistics import Spread

EMPTY = "–"
SMALLEST, LARGEST = -3, 5  # powers of ten between which numbers are written without an exponent
BETWEEN = 3  # characters between two printed columns
FEW, SHORT = 6, 8  # columns and lines of the table that a page shows first
Cell = Callable[[Results], str]  # the text of a cell, of the rows that belong to it


class Table(NamedTuple):
    """Header and lines of text under a title; `labels` counts the first columns, a `folded` table opens on a click."""

    title: str
    header: Sequence[str]
    lines: Sequence[Sequence[str]]
    labels: int = 1
    verdicts: bool = False
    folded: bool = False


def tabulate(
    title: str, groups: Mapping[Any, Results], columns: Mapping[str, Cell], header: Sequence[str] = ("model",)
) -> Table:
    """Return a line per group of rows, by its label or labels (titled `header`); a column per function of a group."""
    lines = [
        (*map(names.label, key if isinstance(key, tuple) else (key,)), *(text(rows) for text in columns.values()))
        for key, rows in groups.items()
    ]
    return Table(title, (*header, *columns), lines, labels=len(header))


def cross_table(
    title: str,
    lines: Mapping[str, Results],
    columns: Mapping[str, Mapping[str, Any]],
    text: Cell,
    corner: str = "model",
) -> Table:
    """Return a line per group of rows, by its label; a column per selection by tags, by its title."""

    def cell(rows: Results, tags: Mapping[str, Any]) -> str:
        own = rows.where(**tags)
        return text(own) if len(own) else EMPTY

    return tabulate(title, lines, {name: partial(cell, tags=tags) for name, tags in columns.items()}, (corner,))


def spread_text(values: Spread, form: str = "", std_form: str = "", what: str = "not finite") -> str:
    """Mean ± standard deviation; values that are not finite are counted as `what`, with the median of all.

    The formats are by default those of `measured`; `std_form` is by default `form`.
    """
    if values.non_finite:
        of = f"{values.non_finite} of {values.count} seeds {what}"
        mean, median = (f"{value:{form or '.3g'}}" for value in (values.mean, values.median))
        return f"{mean} ({of}, median {median})".replace("-inf", "−∞").replace("inf", "∞")
    if not form:
        return measured(values.mean, values.std)
    return f"{values.mean:{form}}" + ("" if math.isnan(values.std) else f" ± {values.std:{std_form or form}}")


def measured(mean: float, std: float) -> str:
    """0.067 ± 0.009: the mean to the last significant digit of the deviation, or (3.2 ± 0.2)e-04 if it is small.

    The deviation has one digit, or two if the first is a 1. Without one (NaN or 0) the mean has three digits.
    """
    if not 0 < std < math.inf or not math.isfinite(mean):
        return f"{mean:.3g}" + ("" if math.isnan(std) else f" ± {std:.3g}")
    size = math.floor(math.log10(abs(mean))) if mean else 0
    power = 0 if SMALLEST <= size < LARGEST else size
    last = math.floor(math.log10(std)) - power
    digits = max(0, -last + (f"{std:e}"[0] == "1"))
    text = f"{mean / 10.0**power:.{digits}f} ± {std / 10.0**power:.{digits}f}"
    return f"({text})e{power:+03d}" if power else text


def over_seeds(results: Results) -> str:
    seeds = len(set(results["seed"]))
    return f"{seeds} seeds" if seeds > 1 else "one seed"


def mean_over_seeds(results: Results) -> str:
    seeds = over_seeds(results)
    return seeds if seeds == "one seed" else f"mean ± std over {seeds}"


def narrowed(table: Table) -> Table:
    title = table.title + f" ({SHORT} of {len(table.lines)} lines)" * (len(table.lines) > SHORT)
    return table._replace(title=title, header=table.header[:FEW], lines=[line[:FEW] for line in table.lines[:SHORT]])


def markdown(table: Any) -> str:
    lines = [table.header, ["---"] * len(table.header), *table.lines]
    return "\n".join(f"| {' | '.join(plain(cell) for cell in line)} |" for line in lines)


def print_table(console: Console, table: Table, most: int = 0) -> None:
    """Print a table without broken words or numbers: the columns that fit, and at most so many lines."""
    header, *lines = ([cell.replace(" ± ", "±") for cell in line] for line in (table.header, *table.lines))
    columns = list(zip(header, *lines, strict=True))
    least = [max(len(word) for cell in column for word in [*cell.split(), ""]) for column in columns]
    ends = np.cumsum([width + BETWEEN for width in least])
    turnable = table.labels == 1 and len(lines) <= len(columns) <= most + 1
    if turnable and ends[-1] >= console.width:
        print_table(console, table._replace(header=columns[0], lines=columns[1:]))
        return
    kept = max(table.labels + 1, int(np.sum(ends < console.width)))
    most = most or len(lines)
    # As Text, or the brackets of a unit would be read as markup.
    printed = RichTable(title=Text(table.title), title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    left = max(0, console.width - 1 - int(ends[min(kept, len(ends)) - 1]))
    for i in range(min(kept, len(columns))):
        more = min(left, max(map(len, columns[i])) - least[i])
        left -= more
        printed.add_column(Text(header[i]), width=least[i] + more)
    for line in lines[:most]:
        printed.add_row(*map(Text, line[:kept]))
    console.print(printed)
    hidden = {"further lines:": len(lines) - most, "columns:": len(columns) - kept}
    if told := ", ".join(f"{what} {count}" for what, count in hidden.items() if count > 0):
        console.print(Text(f"Not shown here: {told}"))


def plain(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())
