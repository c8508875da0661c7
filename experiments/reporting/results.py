"""A table of results: rows with tags that describe the run, and numbers."""

import csv
import io
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, overload

import numpy as np

from experiments.reporting.statistics import Estimate, Spread, mean_interval, spread
from hybrid_jax.io.files import json_value

Row = Mapping[str, Any]  # JSON values by column; a nested column, such as theta, is a mapping
Column = str | Callable[[Row], float]


@dataclass(frozen=True)
class Results:
    """Rows of JSON values. A number that is not finite is stored as None, as in JSON.

    Raises:
        ValueError: a row lacks a tag, two rows have the same tags, or a value has no JSON form.
    """

    rows: Sequence[Row] = ()  # one per run
    tags: Sequence[str] = ()  # columns that identify a row

    def __post_init__(self):
        object.__setattr__(self, "rows", tuple(json_value(row) for row in self.rows))
        object.__setattr__(self, "tags", tuple(self.tags))
        for index, row in enumerate(self.rows):
            if not isinstance(row, dict) or not set(self.tags) <= row.keys():
                raise ValueError(f"rows[{index}] must be an object with {', '.join(self.tags)}")
        keys = Counter(tuple(row[tag] for tag in self.tags) for row in self.rows if self.tags)
        for key, times in keys.most_common(1):
            if times > 1:
                shown = ", ".join(f"{tag} {value}" for tag, value in zip(self.tags, key, strict=True))
                raise ValueError(f"rows must be different in {', '.join(self.tags)}; {times} rows have {shown}")

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, item: int) -> Row: ...
    @overload
    def __getitem__(self, item: str) -> list[Any]: ...
    def __getitem__(self, item):
        """Return one row by its index, or all values of a column by its name."""
        return self.rows[item] if isinstance(item, int) else [row.get(item) for row in self.rows]

    def __add__(self, other: "Results") -> "Results":
        return Results((*self.rows, *other.rows), self.tags or other.tags)

    def where(self, keep: Callable[[Row], bool] | None = None, **tags: Any) -> "Results":
        """Select the rows with these values and with `keep` true; a tuple, list or set allows any of its values."""

        def kept(row: Row) -> bool:
            same = (row.get(t) in v if isinstance(v, tuple | list | set) else row.get(t) == v for t, v in tags.items())
            return all(same) and (keep is None or keep(row))

        return self._with(row for row in self.rows if kept(row))

    def group(self, *columns: str) -> dict[Any, "Results"]:
        """Group rows by a column, or by a tuple of columns, in order of appearance."""
        found: dict[Any, list[Row]] = {}
        for row in self.rows:
            key = tuple(row[column] for column in columns)
            found.setdefault(key if len(columns) > 1 else key[0], []).append(row)
        return {key: self._with(rows) for key, rows in found.items()}

    def sort(self, **orders: Sequence[Any] | None) -> "Results":
        """Sort by columns, the first one most: in the order of a list of values, or ascending for None."""

        def key(row: Row) -> list[Any]:
            return [row[name] if order is None else order.index(row[name]) for name, order in orders.items()]

        return self._with(sorted(self.rows, key=key))

    def unique(self, column: str) -> list[Any]:
        return list(dict.fromkeys(self[column]))

    def tagged(self, **tags: Any) -> "Results":
        rows = tuple({**tags, **{name: row[name] for name in row if name not in tags}} for row in self.rows)
        return Results(rows, (*tags, *(tag for tag in self.tags if tag not in tags)))

    def numbers(self, column: Column, missing: float = math.inf) -> np.ndarray:
        """Return the numbers of a column ("theta.Ix" if nested) or of a function of a row; `missing` if not finite."""

        def read(row: Any) -> Any:
            for name in column.split(".") if isinstance(column, str) else ():
                row = None if row is None else row.get(name)
            return row if isinstance(column, str) else column(row)

        return np.array([missing if (value := read(row)) is None else value for row in self.rows], float)

    def spread(self, column: Column, missing: float = math.inf) -> Spread:
        return spread(self.numbers(column, missing))

    def paired(self, other: "Results", column: Column) -> tuple[np.ndarray, np.ndarray]:
        """Pair a column with another table's by seed and draw; a single row is paired with every seed."""
        theirs = dict(zip(other._runs(), other.numbers(column), strict=True))
        if len(other) == 1:
            return self.numbers(column), np.full(len(self), *theirs.values())
        lacking = [run for run in self._runs() if run not in theirs]
        if lacking:
            seed, draw = lacking[0]
            where = seed if draw is None else f"{seed} of draw {draw}"
            raise ValueError(f"other must have the same seeds, {where} is missing")
        return self.numbers(column), np.array([theirs[run] for run in self._runs()])

    def interval(self, column: Column, minus: "Results | None" = None, times: float = 1.0) -> Estimate:
        """The mean of a column, or of its difference from `times` another table's paired rows."""
        first, second = (self.numbers(column), 0.0) if minus is None else self.paired(minus, column)
        with np.errstate(invalid="ignore"):  # ∞ − ∞ says nothing
            return mean_interval(first - np.multiply(times, second), self["seed"], [str(d) for d in self["draw"]])

    def _runs(self) -> list[tuple[Any, Any]]:
        return list(zip(self["seed"], self["draw"], strict=True))

    def to_csv(self) -> str:
        """CSV; a nested column becomes one per entry, for example theta.Ix, and a missing number an empty cell."""
        lines = [dict(leaves(row, ".")) for row in self.rows]
        text = io.StringIO()
        writer = csv.DictWriter(text, dict.fromkeys(name for line in lines for name in line), lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
        return text.getvalue()

    def _with(self, rows: Iterable[Row]) -> "Results":
        found = object.__new__(Results)
        object.__setattr__(found, "rows", tuple(rows))
        object.__setattr__(found, "tags", self.tags)
        return found


def leaves(tree: Mapping[str, Any], between: str, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Flatten nested mappings, with names joined by `between`."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves(value, between, f"{prefix}{name}{between}")
        else:
            yield f"{prefix}{name}", value


def by_column(rows: Iterable[Row]) -> list[dict[str, list[Any]]]:
    """Return a mapping from names to columns for each run of rows that have the same names."""
    runs = ((names, [row.values() for row in own]) for names, own in groupby(rows, list))
    return [dict(zip(names, map(list, zip(*values, strict=True)), strict=True)) for names, values in runs]


def by_row(tables: Iterable[Mapping[str, Sequence[Any]]]) -> list[Row]:
    """Return the rows that `by_column` was given."""
    return [dict(zip(table, row, strict=True)) for table in tables for row in zip(*table.values(), strict=True)]
