"""Tables of text, the same for a page of Markdown and for a terminal."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from experiments.reporting.results import Results
from experiments.reporting.statistics import Spread

EMPTY = "–"
STYLES = {"✓ holds": "green", "✗ fails": "bold red"}
Cell = Callable[[Results], str]  # the text of a cell, of the rows that belong to it


class Table(NamedTuple):
    """Header and lines of cells, all text, under a title."""

    title: str
    header: Sequence[str]
    lines: Sequence[Sequence[str]]


def tabulate(
    title: str, groups: Mapping[Any, Results], columns: Mapping[str, Cell], header: Sequence[str] = ("model",)
) -> Table:
    """A line per group of rows, by its label or tuple of labels; a column per function of a group, by its title.

    `header` has the titles of the labels' columns.
    """
    lines = [
        (*(label if isinstance(label, tuple) else (label,)), *(text(rows) for text in columns.values()))
        for label, rows in groups.items()
    ]
    return Table(title, (*header, *columns), lines)


def cross_table(
    title: str,
    lines: Mapping[str, Results],
    columns: Mapping[str, Mapping[str, Any]],
    text: Cell,
    corner: str = "model",
) -> Table:
    """A line per group of rows, by its label; a column per selection by tags, by its title; a cell for each pair."""

    def cell(rows: Results, tags: Mapping[str, Any]) -> str:
        own = rows.where(**tags)
        return text(own) if len(own) else EMPTY

    return tabulate(title, lines, {name: partial(cell, tags=tags) for name, tags in columns.items()}, (corner,))


def spread_text(values: Spread, form: str = ".3g", std_form: str = "", what: str = "not finite") -> str:
    """Mean ± standard deviation; with values that are not finite, their number, `what` they are, and the median of all.

    The standard deviation has by default the format of the mean.
    """
    if values.non_finite:
        of = f"{values.non_finite} of {values.count} seeds {what}"
        return f"{values.mean:{form}} ({of}, median {values.median:{form}})".replace("-inf", "−∞").replace("inf", "∞")
    return f"{values.mean:{form}}" + ("" if math.isnan(values.std) else f" ± {values.std:{std_form or form}}")


def over_seeds(results: Results) -> str:
    """How many seeds the rows are of."""
    seeds = len(set(results["seed"]))
    return f"{seeds} seeds" if seeds > 1 else "one seed"


def mean_over_seeds(results: Results) -> str:
    """What the numbers of `spread_text` are, for a title."""
    seeds = over_seeds(results)
    return seeds if seeds == "one seed" else f"mean ± std over {seeds}"


def markdown(table: Table) -> str:
    lines = [table.header, ["---"] * len(table.header), *table.lines]
    return "\n".join(f"| {' | '.join(plain(cell) for cell in line)} |" for line in lines)


def print_tables(console: Console, tables: Sequence[Table]) -> None:
    for table in tables:
        # As Text, or the brackets of a unit would be read as markup.
        printed = RichTable(title=Text(table.title), title_justify="left")
        for name in table.header:
            printed.add_column(Text(name), overflow="fold")
        for line in table.lines:
            printed.add_row(*(Text(cell, style=STYLES.get(cell, "")) for cell in line))
        console.print(printed)


def plain(text: str) -> str:
    """Text that ends neither a table's cell nor a line of Markdown."""
    return " ".join(text.replace("|", "\\|").split())
