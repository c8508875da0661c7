"""Choose among candidates by cross-validation over flights or manoeuvres, and estimate the error on a new flight.

A model should be reliable on flights that nobody has recorded, so each candidate is scored on held-out flights. Each
flight counts once, because its windows share wind, battery and manoeuvre, and seeds share the flight.

1. A candidate that is worse on any flight than the safest baseline (the one with the best worst flight) is rejected.
Only a standard error over seeds is allowed for; the spread between flights would excuse the least reliable.

2. Of the others, the simplest candidate within one standard error of the smallest mean is chosen, by paired differences
(Breiman et al., "Classification and regression trees", 1984).
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
    """Choose the simplest accepted candidate within one standard error of the best."""
    considered = _considered(scores, baselines)
    best = min(considered, key=lambda name: scores[name].mean())
    return next(name for name in considered if _within_error(scores[name], scores[best]))


def _considered(scores: Scores[Named], baselines: Collection[Named]) -> list[Named]:
    """Return the candidates that are nowhere worse than the safest baseline, beyond a standard error over seeds."""
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
    """Return the expected error on another flight and its interval, by Student's t of the flights' log-errors."""
    n, middle = len(logs), logs.mean(axis=0)
    if n < 2:
        return np.stack([np.exp(middle), np.zeros_like(middle), np.full_like(middle, np.inf)])
    half = scipy.special.stdtrit(n - 1, (1 + level) / 2) * logs.std(axis=0, ddof=1) * (1 + 1 / n) ** 0.5
    return np.exp([middle, middle - half, middle + half])
