"""Statistics over seeds: spread, paired differences, and the share of a gap that is closed, with intervals."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit
from scipy.stats import ttest_rel

Values = Sequence[float] | np.ndarray  # of each seed
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


def spread(values: Values) -> Spread:
    array = np.asarray(values, float)
    non_finite = int(np.sum(~np.isfinite(array)))
    with np.errstate(all="ignore"):
        mean, median = float(np.mean(array)), float(np.median(array))
        std = math.nan if len(array) < 2 else math.inf if non_finite else float(np.std(array, ddof=1))
    return Spread(mean, std, median, float(np.min(array)), len(array), non_finite)


def mean_difference(first: Values, second: Values, level: float = LEVEL) -> Interval:
    """The mean of first − second over the seeds where both are finite, with Student's t interval of the paired test.

    What the seeds of a pair share, such as the model from which both started, cancels.
    """
    one, other = _finite(first, second)
    value = float(np.mean(one - other)) if len(one) else math.nan
    if len(one) < 2:
        return Interval(value)
    if np.ptp(one - other) == 0:  # the test has no statistic
        return Interval(value, value, value)
    low, high = ttest_rel(one, other).confidence_interval(level)
    return Interval(value, float(low), float(high))


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
    t = float(stdtrit(len(gap) - 1, (1 + level) / 2))
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
