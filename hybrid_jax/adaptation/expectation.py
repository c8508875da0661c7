"""Estimate the error on an unseen flight from blocks of windows that were left out of the fit."""

import warnings
from collections.abc import Mapping

import numpy as np
import scipy  # not scipy.stats, which takes half a second to import
from jaxtyping import Float

from hybrid_jax.state_space import StateSpace

LEVEL = 0.8
ALIKE = 2  # so many blocks of one flight count as one: neighbours are alike, and another flight differs more
Expected = Mapping[str, Mapping[str, tuple[float, float, float]]]  # horizon → quantity → value, low, high


def expected_errors(squares: Float[np.ndarray, "b 2 d"], seconds: tuple[float, float], space: StateSpace) -> Expected:
    """Return the RMSE at the end of single and of joined windows, with an 80 % prediction interval for an equal flight.

    The interval (Hahn and Meeker, Statistical Intervals, 1991, Sec. 4.7) uses Student's t for the logarithm of the mean
    `squares` over blocks, NaN where a state was not measured; `seconds` are the durations of the windows. Squares after
    a second are skewed, and a few seldom show the largest, so that their own standard deviation is too small: they
    count as lognormal, of which the logarithm of the mean has the variance s²/b + s⁴ / (2 (b − 1)), s² the variance of
    the logarithm (Cox's method; Zhou and Gao, Statistics in Medicine 1997).
    """
    blocks = len(squares)
    with warnings.catch_warnings(action="ignore"):  # a state that is measured at no end
        squares = np.where(np.isnan(squares), np.nanmean(squares, axis=0), squares)
    squares = np.where(np.isfinite(squares), squares, np.nan)  # a diverged one has no RMSE
    quantile = scipy.special.stdtrit(max(blocks - 1, 1), (1 + LEVEL) / 2)

    def around(group: slice, factor: float, horizon: int) -> tuple[float, float, float]:
        power = np.maximum(factor**2 * squares[:, horizon, group].sum(axis=-1), np.finfo(np.float32).tiny)
        away = np.inf
        if blocks > 1:
            variance = np.log(power).var(ddof=1)
            away = quantile * 0.5 * np.sqrt(2 * ALIKE * (variance / blocks + variance**2 / (2 * (blocks - 1))))
        rmse = np.sqrt(power.mean())
        return float(rmse), float(rmse * np.exp(-away)), float(rmse * np.exp(away))

    return {
        f"{seconds[horizon]:g} s": {one.name: around(part, one.scale, horizon) for part, one in space.parts}
        for horizon in range(2 if seconds[1] > seconds[0] else 1)
    }


def lines_of(expected: Expected, units: Mapping[str, str]) -> list[str]:
    def text(name: str, value: float, low: float, high: float) -> str:
        return f"{name} {value:.3g} ({low:.2g} to {high:.2g}) {units[name]}".rstrip()

    return [
        f"  after {horizon}: {', '.join(text(name, *errors) for name, errors in found.items())}"
        for horizon, found in expected.items()
    ]
