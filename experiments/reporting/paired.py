"""Two ways on the same seeds: their mean difference, and the share of a gap that one closes, with intervals.

What the seeds of a pair have in common, such as the model that both began with, cancels. Intervals are Student's t.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

LEVEL = 0.95


class Interval(NamedTuple):
    """An estimate and the ends of its interval, NaN where the seeds cannot bound it."""

    value: float
    low: float
    high: float


def mean_difference(first: Sequence[float], second: Sequence[float], level: float = LEVEL) -> Interval:
    """The mean of first − second over the seeds where both are finite.

    Raises:
        ValueError: different numbers of seeds.
    """
    one, other = _alike(first, second)
    with np.errstate(invalid="ignore"):
        (apart,) = _finite(one - other)
    if len(apart) < 2:
        return Interval(float(apart.mean()) if len(apart) else math.nan, math.nan, math.nan)
    half = math.sqrt(_squared_t(len(apart), level) * apart.var(ddof=1) / len(apart))
    return Interval(float(apart.mean()), float(apart.mean() - half), float(apart.mean() + half))


def share_of_gap(
    before: Sequence[float], after: Sequence[float], reachable: Sequence[float], level: float = LEVEL
) -> Interval:
    """(before − after) / (before − reachable), of the means over the seeds where all three are finite.

    1 closes the gap between before and what is reachable, 0 none of it. The interval is Fieller's ("Some problems in
    interval estimation", 1954): all shares s that a paired t test of (before − after) − s (before − reachable) does not
    reject. Where the seeds are not sure that there is a gap it has no ends, and where there is none it has no value.

    Raises:
        ValueError: different numbers of seeds.
    """
    begun, ended, best = _alike(before, after, reachable)
    with np.errstate(invalid="ignore"):
        closed, gap = _finite(begun - ended, begun - best)
    if len(gap) == 0 or gap.mean() <= 0:
        return Interval(math.nan, math.nan, math.nan)
    value = float(closed.mean() / gap.mean())
    if len(gap) < 2:
        return Interval(value, math.nan, math.nan)
    covariance = np.cov(closed, gap) * _squared_t(len(gap), level) / len(gap)
    a = gap.mean() ** 2 - covariance[1, 1]
    b = closed.mean() * gap.mean() - covariance[0, 1]
    c = closed.mean() ** 2 - covariance[0, 0]
    if a <= 0:
        return Interval(value, math.nan, math.nan)
    half = math.sqrt(max(b * b - a * c, 0.0))
    return Interval(value, float((b - half) / a), float((b + half) / a))


def _alike(*samples: Sequence[float]) -> list[np.ndarray]:
    arrays = [np.asarray(sample, float) for sample in samples]
    if len({array.shape for array in arrays}) > 1:
        raise ValueError(f"the samples must be of the same seeds, got {', '.join(str(a.shape) for a in arrays)}")
    return arrays


def _finite(*samples: np.ndarray) -> list[np.ndarray]:
    """The entries where all are finite."""
    kept = np.all(np.isfinite(samples), axis=0)
    return [sample[kept] for sample in samples]


def _squared_t(count: int, level: float) -> float:
    return float(stdtrit(count - 1, (1 + level) / 2)) ** 2
