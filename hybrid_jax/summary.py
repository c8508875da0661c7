"""What the rows of a cell (model, mode, N) say together."""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hybrid_jax.rows import MODELS, MODES, Row


@dataclass(frozen=True)
class Spread:
    """Values over seeds: an infinite one makes mean and std infinite; std (ddof = 1) of a single value is NaN."""

    mean: float
    std: float
    median: float
    count: int
    non_finite: int


@dataclass(frozen=True)
class Summary:
    """A cell's spread over seeds of test_mse and of ρ."""

    mse: Spread
    rho: Spread


Cell = tuple[str, str, int]  # model, mode, n_train


def grouped(rows: Iterable[Row]) -> dict[Cell, list[Row]]:
    """The rows of each cell, in the order of MODELS, MODES and n_train."""
    groups = defaultdict(list)
    for row in rows:
        groups[row.model, row.mode, row.n_train].append(row)
    return dict(sorted(groups.items(), key=lambda item: _order(item[0])))


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
    return Spread(mean, std, median, len(array), non_finite)


def _order(cell: Cell) -> tuple[int, int, int]:
    return MODELS.index(cell[0]), MODES.index(cell[1]), cell[2]
