"""Choose among candidates by flights, or manoeuvres, left out of their training, and say what error to expect.

Why this rule: what is chosen will be flown on what nobody has recorded. So each candidate is judged on flights that
were left out of its training, and each flight counts once: its windows share wind, battery and manoeuvre, and seeds
share the flight.

1. The worst flight counts as well as the mean. A candidate that, on any flight, is worse than the safest baseline is
   not considered. The safest is that with the best worst flight: one that is the best on average, but fails on a
   flight, would excuse others that fail on it too. Only a standard error over seeds is allowed for: allowing for the
   spread between flights would excuse most what is least reliable.
2. Of the others, the best is that with the smallest mean. A mean over few flights is uncertain, so the simplest
   candidate within one standard error of it, of the paired differences, is chosen (Breiman et al., "Classification and
   regression trees", 1984).
"""

from collections.abc import Collection, Mapping
from typing import TypeVar

import numpy as np
import scipy
from jaxtyping import Float

LEVEL = 0.8
Named = TypeVar("Named")  # a candidate, or any other name of one
# Of each candidate, the simplest first: log of its error over that of thrust with frozen rates, mean over quantities.
Scores = Mapping[Named, Float[np.ndarray, "flights seeds"]]


def choose(scores: Scores[Named], baselines: Collection[Named]) -> Named:
    """The simplest candidate within one standard error of the best, of those that are considered."""
    considered = _considered(scores, baselines)
    best = min(considered, key=lambda name: scores[name].mean())
    return next(name for name in considered if _within_error(scores[name], scores[best]))


def _considered(scores: Scores[Named], baselines: Collection[Named]) -> list[Named]:
    """The candidates that are nowhere worse than the safest baseline, beyond a standard error over seeds."""
    finite = [name for name, each in scores.items() if np.isfinite(each).all()]
    worst = {name: scores[name].mean(axis=1).max() for name in finite if name in baselines}
    baseline = scores[min(worst, key=worst.__getitem__)]

    def safe(name: Named) -> bool:
        worse = scores[name] - baseline
        seeds = worse.shape[1]
        error = worse.std(axis=1, ddof=1) / seeds**0.5 if seeds > 1 else 0.0
        return bool((worse.mean(axis=1) <= error).all())

    return [name for name in finite if safe(name)]


def _within_error(scores: np.ndarray, best: np.ndarray) -> bool:
    worse = (scores - best).mean(axis=1)
    error = worse.std(ddof=1) / len(worse) ** 0.5 if len(worse) > 1 else 0.0
    return bool(worse.mean() <= error)


def expected(logs: Float[np.ndarray, "flights ..."], level: float = LEVEL) -> Float[np.ndarray, "3 ..."]:
    """The error to expect on another flight, and both ends of its interval, from the logs of errors on flights.

    Student's t: logs of errors of flights are taken as draws from one normal distribution. One flight bounds nothing.
    """
    n, middle = len(logs), logs.mean(axis=0)
    if n < 2:
        return np.stack([np.exp(middle), np.zeros_like(middle), np.full_like(middle, np.inf)])
    half = scipy.special.stdtrit(n - 1, (1 + level) / 2) * logs.std(axis=0, ddof=1) * (1 + 1 / n) ** 0.5
    return np.exp([middle, middle - half, middle + half])
