"""What the rows of a cell (model, mode, N) of one domain say together."""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.paper.rows import DOMAINS, MODELS, MODES, NAMES, RIVALS, Row


@dataclass(frozen=True)
class Spread:
    """Values over seeds: an infinite one makes mean and std infinite; std (ddof = 1) of a single value is NaN."""

    mean: float
    std: float
    median: float
    smallest: float
    count: int
    non_finite: int


@dataclass(frozen=True)
class Summary:
    """A cell's spread over seeds of test_mse and of ρ."""

    mse: Spread
    rho: Spread


Cell = tuple[str, str, int]  # model, mode, n_train


def by_domain(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The rows of each domain that has any, in the order of DOMAINS."""
    rows = list(rows)
    split = {domain: [row for row in rows if row.domain == domain] for domain in DOMAINS}
    return {domain: group for domain, group in split.items() if group}


def grouped(rows: Iterable[Row]) -> dict[Cell, list[Row]]:
    """The rows of each cell, in the order of MODELS, MODES and n_train.

    Raises:
        ValueError: rows of several domains, which have no mean together.
    """
    rows, groups = list(rows), defaultdict(list)
    domains = sorted({row.domain for row in rows})
    if len(domains) > 1:
        raise ValueError(f"rows must be of one domain, got {', '.join(domains)}")
    for row in rows:
        groups[row.model, row.mode, row.n_train].append(row)
    return dict(sorted(groups.items(), key=lambda item: _order(item[0])))


def ranked(rows: Iterable[Row]) -> dict[Cell, list[Row]]:
    """`grouped`, the cell of the smallest mean error first; among infinite means that of the smallest error."""

    def error(item: tuple[Cell, list[Row]]) -> tuple[float, float]:
        values = spread([row.error for row in item[1]])
        return values.mean, values.smallest

    return dict(sorted(grouped(rows).items(), key=error))


def method(cell: Cell) -> str:
    """A cell as a method for people, without its N: fine-tuning needs no word, nor does a rival that never adapts."""
    model, mode, _ = cell
    unsaid = mode == "fine_tuned" or (mode == "source_only" and model in RIVALS)
    return NAMES[model] if unsaid else f"{NAMES[model]}, {NAMES[mode]}"


def summarise(rows: Iterable[Row]) -> dict[Cell, Summary]:
    """Mean, std (ddof = 1), median and count over the seeds of each cell."""
    return {
        cell: Summary(spread([row.error for row in group]), spread([row.gain for row in group]))
        for cell, group in grouped(rows).items()
    }


def spread(values: Sequence[float]) -> Spread:
    """The spread of at least one value."""
    array = np.asarray(values, float)
    non_finite = int(np.sum(~np.isfinite(array)))
    with np.errstate(all="ignore"):
        mean, median = float(np.mean(array)), float(np.median(array))
        std = math.nan if len(array) < 2 else math.inf if non_finite else float(np.std(array, ddof=1))
    return Spread(mean, std, median, float(np.min(array)), len(array), non_finite)


def _order(cell: Cell) -> tuple[int, int, int]:
    return MODELS.index(cell[0]), MODES.index(cell[1]), cell[2]
