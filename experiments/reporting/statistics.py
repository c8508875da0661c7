"""Statistics of runs over seeds and draws: spreads, and confidence intervals of means, ratios and shares."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy  # which imports scipy.stats where it is first used

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


class Estimate(NamedTuple):
    """An estimate and the ends of its confidence interval, NaN if the seeds cannot bound it."""

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan

    def below(self, limit: float) -> bool | None:
        """Whether the whole interval is below the limit; False if it is all above, None if it is not significant."""
        return True if self.high < limit else False if self.low > limit else None

    def above(self, limit: float) -> bool | None:
        return Estimate(-self.value, -self.high, -self.low).below(-limit)

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


def mean_interval(values: Values, seeds: Labels, draws: Labels | None = None) -> Estimate:
    """The mean of the values of runs, with a confidence interval over seeds and draws of flights.

    The variance is clustered by seed and by draw, V_seed + V_draw − V_both (Cameron, Gelbach, Miller, "Robust inference
    with multiway clustering", 2011), but not below V_seed or V_draw; with one draw the interval is Student's. An
    infinite value makes the mean infinite; one seed bounds nothing.
    """
    array = np.asarray(values, float)
    with np.errstate(invalid="ignore"):
        mean = float(np.mean(array)) if len(array) else math.nan
    ways = [list(seeds), list(seeds if draws is None else draws)]
    clusters = [count for way in ways if (count := len(set(way))) > 1]
    if len(set(ways[0])) < 2 or math.isnan(mean):
        return Estimate(mean)
    if math.isinf(mean):
        return Estimate(mean, mean, mean)

    def variance(labels: Labels) -> float:
        sums = np.bincount(np.unique(labels, return_inverse=True)[1].ravel(), array - mean)
        return 0.0 if len(sums) < 2 else float(sums @ sums) * len(sums) / (len(sums) - 1) / len(array) ** 2

    one, other, both = map(variance, (*ways, np.arange(len(array))))
    t = float(scipy.special.stdtrit(min(clusters) - 1, (1 + LEVEL) / 2))
    half = t * math.sqrt(max(one + other - both, one, other))
    return Estimate(mean, mean - half, mean + half)


def share_interval(holds: Sequence[bool] | np.ndarray, seeds: Labels) -> Estimate:
    """The share of runs in which something holds, with a confidence interval that is clustered by seed.

    It is the exact interval (Clopper and Pearson 1934) of so many independent runs that the share would be known as
    well (Korn and Graubard, "Confidence intervals for proportions with small expected number of positive counts
    estimated from survey data", Survey Methodology 1998). Where all hold, or none, one run for each seed counts, since
    nothing shows how alike its runs are; one seed bounds nothing.
    """
    array, of = np.asarray(holds, float), np.unique(seeds, return_inverse=True)[1].ravel()
    n, clusters, share = len(array), len(set(of)), float(np.mean(array))
    if clusters < 2:
        return Estimate(share)
    sums = np.bincount(of, array - share)
    variance = sums @ sums * clusters / (clusters - 1) / n**2
    fewer = np.square(np.divide(*scipy.special.stdtrit([n - 1, clusters - 1], (1 + LEVEL) / 2)))
    count = float(clusters if share in (0, 1) else fewer * min(n, share * (1 - share) / variance if variance else n))
    held, tail = share * count, (1 - LEVEL) / 2
    low = scipy.special.betaincinv(held, count - held + 1, tail) if held else 0.0
    high = scipy.special.betaincinv(held + 1, count - held, 1 - tail) if held < count else 1.0
    return Estimate(share, float(low), float(high))


def ratio_of_stds(first: Values, second: Values) -> Estimate:
    """The ratio of paired standard deviations, with the interval of Pitman and Morgan's test (1939)."""
    above, below = spread(first).std, spread(second).std
    if math.isnan(above + below) or (above == below and above in (0.0, math.inf)):
        return Estimate()
    if 0 in (above, below) or math.inf in (above, below):
        ratio = math.inf if below == 0 or above == math.inf else 0.0
        return Estimate(ratio, ratio, ratio)
    if len(first) < 3:
        return Estimate(above / below)
    t, freedom = float(scipy.special.stdtrit(len(first) - 2, (1 + LEVEL) / 2)), len(first) - 2
    k = 1 + 2 * max(0.0, 1 - float(np.corrcoef(first, second)[0, 1]) ** 2) * t**2 / freedom
    reach = math.sqrt(k + math.sqrt(k * k - 1))
    return Estimate(above / below, above / below / reach, above / below * reach)


def share_of_gap(before: Values, after: Values, reachable: Values) -> Estimate:
    """(before − after) / (before − reachable), of the means over the seeds where all three are finite.

    The interval is Fieller's ("Some problems in interval estimation", 1954): all shares s for which a paired t test
    does not reject (before − after) = s (before − reachable). It is unbounded if the gap is not significant, and NaN
    without a gap.
    """
    start, end, best = _finite(before, after, reachable)
    closed, gap = start - end, start - best
    if len(gap) == 0 or gap.mean() <= 0:
        return Estimate()
    value = float(closed.mean() / gap.mean())
    if len(gap) < 2:
        return Estimate(value)
    t = float(scipy.special.stdtrit(len(gap) - 1, (1 + LEVEL) / 2))
    covariance = np.cov(closed, gap) * t**2 / len(gap)
    a = gap.mean() ** 2 - covariance[1, 1]
    b = closed.mean() * gap.mean() - covariance[0, 1]
    c = closed.mean() ** 2 - covariance[0, 0]
    if a <= 0:
        return Estimate(value)
    half = math.sqrt(max(b * b - a * c, 0.0))
    return Estimate(value, float((b - half) / a), float((b + half) / a))


def _finite(*samples: Values) -> list[np.ndarray]:
    """Return the samples at the seeds where all are finite."""
    arrays = [np.asarray(sample, float) for sample in samples]
    if len({array.shape for array in arrays}) > 1:
        raise ValueError(f"the samples must be of the same seeds, got {', '.join(str(a.shape) for a in arrays)}")
    kept = np.all(np.isfinite(arrays), axis=0)
    return [array[kept] for array in arrays]
