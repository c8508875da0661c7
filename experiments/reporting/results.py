"""A table of results, whose rows have tags that say what was run, and the numbers that it gave; statistics of seeds."""

import csv
import io
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, overload

import numpy as np
import scipy  # which imports scipy.stats where it is first used

from hybrid_jax.io.files import json_value

Row = Mapping[str, Any]  # JSON values by column; a nested column, such as theta, is a mapping
Column = str | Callable[[Row], float]
Values = Sequence[float] | np.ndarray  # of each seed
Labels = Sequence[Any] | np.ndarray  # the seeds of runs, or their draws
LEVEL = 0.95


class Spread(NamedTuple):
    """Values over seeds: an infinite one makes mean and std infinite; std (ddof = 1) of a single value is NaN."""

    mean: float
    std: float
    median: float
    smallest: float
    count: int
    non_finite: int


class Interval(NamedTuple):
    """An estimate and the ends of its confidence interval, NaN where the seeds cannot bound it."""

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan

    def below(self, limit: float) -> bool | None:
        """Whether the whole interval is below the limit; False if it is all above, None if it does not tell."""
        return True if self.high < limit else False if self.low > limit else None

    def above(self, limit: float) -> bool | None:
        return Interval(-self.value, -self.high, -self.low).below(-limit)

    def text(self, form: str = ".3g") -> str:
        known = f"{self.low:{form}} … {self.high:{form}}" if self.low < self.high else "no interval"
        certain = math.isinf(self.value) or self.low == self.high
        return (f"{self.value:{form}}" + ("" if certain else f" ({known})")).replace("inf", "∞")


def spread(values: Values) -> Spread:
    array = np.asarray(values, float)
    non_finite = int(np.sum(~np.isfinite(array)))
    with np.errstate(all="ignore"):
        mean, median = float(np.mean(array)), float(np.median(array))
        std = math.nan if len(array) < 2 else math.inf if non_finite else float(np.std(array, ddof=1))
    return Spread(mean, std, median, float(np.min(array)), len(array), non_finite)


def mean_interval(values: Values, seeds: Labels, draws: Labels | None = None) -> Interval:
    """The mean of the values of runs, with a confidence interval over seeds and draws of flights.

    Runs of the same seed are related, and so are runs of the same draw. The variance is clustered both ways, V_seed +
    V_draw − V_both (Cameron, Gelbach, Miller, "Robust inference with multiway clustering", 2011), but not below V_seed
    or V_draw. With one draw the interval is Student's. An infinite value makes the mean infinite, for certain; one
    seed bounds nothing.
    """
    array = np.asarray(values, float)
    with np.errstate(invalid="ignore"):
        mean = float(np.mean(array)) if len(array) else math.nan
    ways = [list(seeds), list(seeds if draws is None else draws)]
    clusters = [count for way in ways if (count := len(set(way))) > 1]
    if len(set(ways[0])) < 2 or math.isnan(mean):
        return Interval(mean)
    if math.isinf(mean):
        return Interval(mean, mean, mean)

    def variance(labels: Labels) -> float:
        sums = np.bincount(np.unique(labels, return_inverse=True)[1].ravel(), array - mean)
        return 0.0 if len(sums) < 2 else float(sums @ sums) * len(sums) / (len(sums) - 1) / len(array) ** 2

    one, other, both = map(variance, (*ways, np.arange(len(array))))
    t = float(scipy.special.stdtrit(min(clusters) - 1, (1 + LEVEL) / 2))
    half = t * math.sqrt(max(one + other - both, one, other))
    return Interval(mean, mean - half, mean + half)


def ratio_of_stds(first: Values, second: Values) -> Interval:
    """The standard deviation of first over that of second, of the same seeds, with the interval of the test of Pitman
    and Morgan (1939). An infinite value makes a standard deviation infinite."""
    above, below = spread(first).std, spread(second).std
    if math.isnan(above + below) or (above == below and above in (0.0, math.inf)):
        return Interval()
    if 0 in (above, below) or math.inf in (above, below):
        ratio = math.inf if below == 0 or above == math.inf else 0.0
        return Interval(ratio, ratio, ratio)
    if len(first) < 3:
        return Interval(above / below)
    t, freedom = float(scipy.special.stdtrit(len(first) - 2, (1 + LEVEL) / 2)), len(first) - 2
    k = 1 + 2 * max(0.0, 1 - float(np.corrcoef(first, second)[0, 1]) ** 2) * t**2 / freedom
    reach = math.sqrt(k + math.sqrt(k * k - 1))
    return Interval(above / below, above / below / reach, above / below * reach)


def share_of_gap(before: Values, after: Values, reachable: Values, level: float = LEVEL) -> Interval:
    """(before − after) / (before − reachable), of the means over the seeds where all three are finite.

    1 closes the gap between before and what is reachable, 0 none of it. The interval is Fieller's ("Some problems in
    interval estimation", 1954): all shares s for which a paired t test does not reject (before − after) =
    s (before − reachable). It has no ends if the gap is not significant, and no value if there is no gap.
    """
    start, end, best = _finite(before, after, reachable)
    closed, gap = start - end, start - best
    if len(gap) == 0 or gap.mean() <= 0:
        return Interval()
    value = float(closed.mean() / gap.mean())
    if len(gap) < 2:
        return Interval(value)
    t = float(scipy.special.stdtrit(len(gap) - 1, (1 + level) / 2))
    covariance = np.cov(closed, gap) * t**2 / len(gap)
    a = gap.mean() ** 2 - covariance[1, 1]
    b = closed.mean() * gap.mean() - covariance[0, 1]
    c = closed.mean() ** 2 - covariance[0, 0]
    if a <= 0:
        return Interval(value)
    half = math.sqrt(max(b * b - a * c, 0.0))
    return Interval(value, float((b - half) / a), float((b + half) / a))


def _finite(*samples: Values) -> list[np.ndarray]:
    """The samples at the seeds where all are finite."""
    arrays = [np.asarray(sample, float) for sample in samples]
    if len({array.shape for array in arrays}) > 1:
        raise ValueError(f"the samples must be of the same seeds, got {', '.join(str(a.shape) for a in arrays)}")
    kept = np.all(np.isfinite(arrays), axis=0)
    return [array[kept] for array in arrays]


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
        """One row by its index, or all values of a column by its name."""
        return self.rows[item] if isinstance(item, int) else [row.get(item) for row in self.rows]

    def __add__(self, other: "Results") -> "Results":
        return Results((*self.rows, *other.rows), self.tags or other.tags)

    def where(self, keep: Callable[[Row], bool] | None = None, **tags: Any) -> "Results":
        """The rows with these values, for which `keep` holds; a tuple, list or set allows any of its values."""

        def kept(row: Row) -> bool:
            same = (row.get(t) in v if isinstance(v, tuple | list | set) else row.get(t) == v for t, v in tags.items())
            return all(same) and (keep is None or keep(row))

        return self._with(row for row in self.rows if kept(row))

    def group(self, *columns: str) -> dict[Any, "Results"]:
        """The rows of each value of a column, or of each tuple of values of several, in order of appearance."""
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
        """The rows with further tags, or other values of these."""
        rows = tuple({**tags, **{name: row[name] for name in row if name not in tags}} for row in self.rows)
        return Results(rows, (*tags, *(tag for tag in self.tags if tag not in tags)))

    def numbers(self, column: Column, missing: float = math.inf) -> np.ndarray:
        """The numbers of a column or of a function of a row; what was not finite counts as `missing`.

        A nested column has a dotted path: "theta.Ix".
        """

        def read(row: Any) -> Any:
            for name in column.split(".") if isinstance(column, str) else ():
                row = None if row is None else row.get(name)
            return row if isinstance(column, str) else column(row)

        return np.array([missing if (value := read(row)) is None else value for row in self.rows], float)

    def spread(self, column: Column, missing: float = math.inf) -> Spread:
        """Mean, standard deviation and more of a column; see `numbers`."""
        return spread(self.numbers(column, missing))

    def paired(self, other: "Results", column: Column) -> tuple[np.ndarray, np.ndarray]:
        """The numbers of a column here, and of the rows with the same seeds and draws in another table.

        A table of one row, such as that of a model that was not trained, is paired with every seed.
        """
        theirs = dict(zip(other._runs(), other.numbers(column), strict=True))
        if len(other) == 1:
            return self.numbers(column), np.full(len(self), *theirs.values())
        lacking = [run for run in self._runs() if run not in theirs]
        if lacking:
            seed, draw = lacking[0]
            where = seed if draw is None else f"{seed} of draw {draw}"
            raise ValueError(f"other must hold the same seeds, {where} is missing")
        return self.numbers(column), np.array([theirs[run] for run in self._runs()])

    def interval(self, column: Column, minus: "Results | None" = None, times: float = 1.0) -> Interval:
        """The mean of a column, or of its difference from `times` that of another table's paired rows."""
        first, second = (self.numbers(column), 0.0) if minus is None else self.paired(minus, column)
        with np.errstate(invalid="ignore"):  # ∞ − ∞ says nothing
            return mean_interval(first - np.multiply(times, second), self["seed"], [str(d) for d in self["draw"]])

    def _runs(self) -> list[tuple[Any, Any]]:
        return list(zip(self["seed"], self["draw"], strict=True))

    def to_csv(self) -> str:
        """CSV. A nested column becomes one per entry: theta.Ix is `Ix`, and its theta_interval `Ix_low` and `Ix_high`.

        A number that is not finite is `null`; a cell is empty where a row has no such number.
        """
        nested = {name for row in self.rows for name, value in row.items() if isinstance(value, dict)}
        names: dict[str, Any] = {}
        lines = []
        for row in self.rows:
            line: dict[str, Any] = {}
            for name, value in row.items():
                if (of := name.removesuffix("_interval")) not in nested:
                    line[name] = value
                elif of == name:
                    line |= leaves(value or {}, " ")
                else:  # columns for all entries, also of a row without intervals
                    names |= line | _ends(dict.fromkeys(row[of] or {}))
                    line |= _ends(value or {})
            names |= line
            lines.append({name: "null" if value is None else value for name, value in line.items()})
        text = io.StringIO()
        writer = csv.DictWriter(text, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
        return text.getvalue()

    def _with(self, rows: Iterable[Row]) -> "Results":
        """Some of these rows, which need no check."""
        found = object.__new__(Results)
        object.__setattr__(found, "rows", tuple(rows))
        object.__setattr__(found, "tags", self.tags)
        return found


def leaves(tree: Mapping[str, Any], between: str, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested mappings, by their names joined with `between`."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves(value, between, f"{prefix}{name}{between}")
        else:
            yield f"{prefix}{name}", value


def _ends(intervals: Mapping[str, Any]) -> dict[str, Any]:
    pairs = {name: pair or (None, None) for name, pair in intervals.items()}
    return {f"{name}_{end}": pair[i] for name, pair in pairs.items() for i, end in enumerate(("low", "high"))}
