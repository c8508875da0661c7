"""Tables of text, the same for a page of Markdown and for a terminal."""

import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from experiments.reporting.results import Results
from experiments.reporting.statistics import Spread

EMPTY = "–"
STYLES = {"✓ holds": "green", "✗ fails": "bold red"}
SMALLEST, LARGEST = -3, 5  # powers of ten between which numbers are written without an exponent
BETWEEN = 3  # characters between two printed columns, and one more in all
NEAR = re.compile(
    r"(?<=[±✓✗]) | (?=±)|(?<=\bN) (?==)|(?<=\bN =) |(?<=^–) |(?<=\d) (?=%|m\b|s\b|ms\b|Hz\b|kg\b|m/s|rad/s)"
)  # spaces that no line may end at
TIED = "\0"
NUMBER = re.compile(r"\(?(?P<number>[-+]?\d+\.?\d*(?:e[-+]?\d+)?)(?:[^(]*\)(?P<power>e[-+]?\d+))?")
Cell = Callable[[Results], str]  # the text of a cell, of the rows that belong to it


class Table(NamedTuple):
    """Header and lines of cells, all text, under a title."""

    title: str
    header: Sequence[str]
    lines: Sequence[Sequence[str]]
    best: Literal["", "line", "column"] = ""  # the smallest number of each line or column is the best
    labels: int = 1  # columns that say what a line is of
    verdicts: bool = False  # whether these are verdicts, which a smoke run must not show
    folded: bool = False  # whether a page shows it on a click alone


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
    return Table(title, (*header, *columns), lines, labels=len(header))


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


def spread_text(values: Spread, form: str = "", std_form: str = "", what: str = "not finite") -> str:
    """Mean ± standard deviation; with values that are not finite, their number, `what` they are, and the median of all.

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
    """0.067 ± 0.009: the mean to the last digit that the standard deviation leaves, as (3.2 ± 0.2)e-04 if it is small.

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
    """How many seeds the rows are of."""
    seeds = len(set(results["seed"]))
    return f"{seeds} seeds" if seeds > 1 else "one seed"


def mean_over_seeds(results: Results) -> str:
    """What the numbers of `spread_text` are, for a title."""
    seeds = over_seeds(results)
    return seeds if seeds == "one seed" else f"mean ± std over {seeds}"


def number_in(text: str) -> float | None:
    """The number that a cell begins with, if any: 0.067 of "0.067 ± 0.009", 3.2e-4 of "(3.2 ± 0.2)e-04"."""
    if (text := text.replace("−", "-").strip()).startswith(("∞", "-∞")):
        return math.inf if text[0] == "∞" else -math.inf
    found = NUMBER.match(text)
    return float(found["number"] + (found["power"] or "")) if found else None


def best_cells(table: Table) -> set[tuple[int, int]]:
    """Line and column of each cell that holds the smallest number of its line or column, if that is the best."""
    numbers = {(i, j): number_in(text) for i, line in enumerate(table.lines) for j, text in enumerate(line)}
    axis = {"line": 0, "column": 1}.get(table.best)
    groups: dict[int, dict[tuple[int, int], float]] = {}
    for place, number in numbers.items():
        if axis is not None and number is not None and math.isfinite(number) and place[1] >= table.labels:
            groups.setdefault(place[axis], {})[place] = number
    return {place for own in groups.values() if len(own) > 1 for place in own if own[place] == min(own.values())}


def narrowed(table: Table, most: int = 6) -> Table:
    """The table with its labels, its best columns and the first of the others, in at most so many columns."""
    best = [column for _, column in sorted(best_cells(table), key=lambda place: place[1])]
    wanted = list(dict.fromkeys([*range(table.labels), *best, *range(len(table.header))]))[:most]
    kept = sorted(wanted)
    lines = [[line[i] for i in kept] for line in table.lines]
    return (
        table if len(kept) == len(table.header) else table._replace(header=[table.header[i] for i in kept], lines=lines)
    )


def markdown(table: Table) -> str:
    lines = [table.header, ["---"] * len(table.header), *table.lines]
    return "\n".join(f"| {' | '.join(plain(cell) for cell in line)} |" for line in lines)


def print_tables(console: Console, tables: Sequence[Table]) -> None:
    """Print tables so that no word and no number is broken; one that is too wide comes in parts below each other."""
    for table in tables:
        for i, columns in enumerate(parts := columns_of_parts(table, console.width)):
            of = f" ({i + 1} of {len(parts)})" if len(parts) > 1 else ""
            console.print(_printed(table, columns, console.width, table.title + of))


def columns_of_parts(table: Table, width: int) -> list[list[int]]:
    """The columns of each part of a table, each part with the labels, such that its longest words fit."""
    least = [min(least, width // 2) for least, _ in _widths(table)]
    labels = list(range(table.labels))
    if sum(least[: table.labels]) + BETWEEN * table.labels > width // 2:
        labels = labels[:1]
    alone = width - 1 - sum(least[i] + BETWEEN for i in labels)
    parts, room = [labels], alone
    for i in range(len(labels), len(least)):
        if least[i] + BETWEEN > room and len(parts[-1]) > len(labels):
            parts.append(labels)
            room = alone
        parts[-1] = [*parts[-1], i]
        room -= least[i] + BETWEEN
    return parts


def _printed(table: Table, columns: Sequence[int], width: int, title: str) -> RichTable:
    # As Text, or the brackets of a unit would be read as markup.
    printed = RichTable(title=Text(title), title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    known = [_widths(table)[i] for i in columns]
    widths = dict(zip(columns, _shared(known, width - BETWEEN * len(columns) - 1), strict=True))
    for i, own in widths.items():
        printed.add_column(Text(_wrapped(table.header[i], own)), width=own, no_wrap=True, overflow="ellipsis")
    for line in table.lines:
        printed.add_row(*(Text(_wrapped(line[i], own), style=STYLES.get(line[i], "")) for i, own in widths.items()))
    return printed


def _widths(table: Table) -> list[tuple[int, int]]:
    """Of each column the lengths of its longest word and of its longest cell."""
    columns = zip(table.header, *table.lines, strict=True)
    return [(max(len(word) for cell in own for word in _words(cell)), max(map(len, own))) for own in columns]


def _shared(widths: Sequence[tuple[int, int]], room: int) -> list[int]:
    """Room for each column: first the longest words, then whole cells, the shortest first."""
    given = [min(least, room // 2) for least, _ in widths]
    left = room - sum(given)
    for after, i in enumerate(order := sorted(range(len(widths)), key=lambda i: widths[i][1] - given[i])):
        more = min(widths[i][1] - given[i], left // (len(order) - after))
        given[i] += more
        left -= more
    return given


def _words(text: str) -> list[str]:
    """The parts that no line may end within: a mean stays with its deviation, and a number with its unit."""
    return NEAR.sub(TIED, text).split(" ")


def _wrapped(text: str, width: int) -> str:
    lines = textwrap.wrap(NEAR.sub(TIED, text), width, break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines).replace(TIED, " ")


def plain(text: str) -> str:
    """Text that ends neither a table's cell nor a line of Markdown."""
    return " ".join(text.replace("|", "\\|").split())
