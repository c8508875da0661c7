"""Pool physical parameters from several sources, with intervals that include the error of the networks."""

from collections.abc import Sequence

import numpy as np
import scipy
from jaxtyping import Float

from hybrid_jax import checks
from hybrid_jax.adaptation.results import Adaptation, Parameter
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import check_level, named_parameters
from hybrid_jax.runtime import entry

SOURCES = 3  # at least so many: the variance between two says nothing


@entry
def pool(results: Sequence[Adaptation], level: float = 0.95) -> dict[str, Parameter]:
    """Pool the parameters that all results share, with intervals from the variance within and between results.

    The covariance of one fit assumes an exact network. Sources with different seeds differ in what their networks
    absorbed, so they are combined as in multiple imputation (Rubin, Multiple Imputation for Nonresponse in Surveys,
    1987, Sec. 3.1).

    Args:
        results: adaptations of sources that were trained with different seeds, all to the same windows.
        level: confidence level.

    Raises:
        ValueError: fewer than three results, or one without intervals; the message says which.
    """
    check_level(level)
    results = checks.list_of("results", results, Adaptation)
    if len(results) < SOURCES:
        raise ValueError(f"results must be of at least {SOURCES} sources, got {len(results)}")
    for i, result in enumerate(results):
        if result.covariance is None:
            raise ValueError(f"results[{i}] has no intervals: {result.without_intervals}")
    fitted = [
        {name for name, one in result.parameters.items() if one.has_interval or one.effective} for result in results
    ]
    estimates = [_estimates(result) for result in results]
    found = {}
    for name in (name for name in results[0].parameters if all(name in own for own in fitted)):
        values, variances = np.array([own[name] for own in estimates]).T
        centre, away = combined(values, variances, level, min(result.degrees or np.inf for result in results))
        low, high = sorted(_at(results[0], name, end) for end in (centre - away, centre + away))
        found[name] = Parameter(_at(results[0], name, centre), low, high, results[0].parameters[name].unit)
    return found


def combined(
    estimates: Float[np.ndarray, " m"], variances: Float[np.ndarray, " m"], level: float = 0.95, degrees: float = np.inf
) -> tuple[float, float]:
    """The mean of m estimates and the half-width of its interval, given the variance of each (Rubin, Eq. 3.1.2–8).

    Degrees of freedom follow Barnard and Rubin (Biometrika 1999), at least m − 1 where nearly all variance is between
    the estimates, and at most `degrees`.
    """
    m = len(estimates)
    between = (1 + 1 / m) * np.var(estimates, ddof=1)
    total = np.mean(variances) + between
    share = between / total
    # Inverse degrees of freedom of the variance between the estimates, and of that within.
    ours = share**2 / (m - 1)
    own = (degrees + 3) / (degrees + 1) / degrees / (1 - share) if np.isfinite(degrees) and share < 1 else 0.0
    freedom = max(1 / (ours + own), min(m - 1, degrees)) if ours + own > 0 else np.inf
    return float(np.mean(estimates)), float(scipy.special.stdtrit(freedom, (1 + level) / 2) * np.sqrt(total))


def _estimates(result: Adaptation) -> dict[str, tuple[float, float]]:
    theta, _ = ravel_parameters(result.field)
    assert result.covariance is not None
    pairs = zip(theta.tolist(), np.diag(result.covariance).tolist(), strict=True)
    return dict(zip(named_parameters(result.field), pairs, strict=True))


def _at(result: Adaptation, name: str, value: float) -> float:
    theta, unravel = ravel_parameters(result.field)
    return float(named_parameters(unravel(theta.at[[*result.parameters].index(name)].set(value)))[name])
