"""Choose among candidates by errors on held-out flights, and estimate the error on a new flight."""

from collections.abc import Mapping

import numpy as np
import scipy
from jaxtyping import Float

LEVEL = 0.8


def choose(scores: Mapping[str, Float[np.ndarray, " flights"]]) -> str:
    """Choose a candidate by its log-errors on held-out flights; the first is the baseline, and the simplest are first.

    A model should be reliable on flights that nobody has recorded, so one that is worse than the baseline on any flight
    is rejected. Of the others, the simplest within one standard error of the smallest mean is chosen, by paired
    differences (Breiman et al., "Classification and regression trees", 1984). Each flight counts once, because its
    windows share wind, battery and manoeuvre.
    """
    baseline = next(iter(scores.values()))
    considered = {name: each for name, each in scores.items() if np.isfinite(each).all() and (each <= baseline).all()}
    best = min(considered.values(), key=np.mean)
    return next(name for name, each in considered.items() if _within_error(each - best))


def _within_error(worse: Float[np.ndarray, " flights"]) -> bool:
    error = worse.std(ddof=1) / len(worse) ** 0.5 if len(worse) > 1 else 0.0
    return bool(worse.mean() <= error)


def expected(logs: Float[np.ndarray, "flights ..."], level: float = LEVEL) -> Float[np.ndarray, "3 ..."]:
    """Return the expected error on another flight and its interval, by Student's t of the flights' log-errors."""
    n, middle = len(logs), logs.mean(axis=0)
    if n < 2:
        return np.stack([np.exp(middle), np.zeros_like(middle), np.full_like(middle, np.inf)])
    half = scipy.special.stdtrit(n - 1, (1 + level) / 2) * logs.std(axis=0, ddof=1) * (1 + 1 / n) ** 0.5
    return np.exp([middle, middle - half, middle + half])
