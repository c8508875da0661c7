"""Pool the parameters of several sources, which differ by the errors of their networks; sum variances."""

from collections.abc import Sequence

import numpy as np
import scipy
from jaxtyping import Float

from hybrid_jax import checks
from hybrid_jax.adaptation.results import Adaptation, Parameter
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import check_level, named_parameters
from hybrid_jax.runtime import entry

SOURCES = 3  # the fewest: the variance between two is too uncertain


@entry
def pool(results: Sequence[Adaptation], level: float = 0.95) -> dict[str, Parameter]:
    """Combine the parameters of several results. Intervals include the variance within and between results.

    Sources with different seeds differ in what their networks absorbed, and the variance between them shows it, as in
    multiple imputation (Rubin, Multiple Imputation for Nonresponse in Surveys, 1987, Sec. 3.1). It does not show what
    all networks absorbed alike, for example a drag that physics lacks: the variance of each result counts whole, and a
    parameter that most results call effective remains so, without an interval.

    Args:
        results: adaptations of sources that were trained with different seeds, all to the same windows.
        level: confidence level.

    Raises:
        ValueError: if there are fewer than three results, or one has no intervals.
    """
    check_level(level)
    results = checks.list_of("results", results, Adaptation)
    if len(results) < SOURCES:
        raise ValueError(f"results must come from at least {SOURCES} source models, got {len(results)}")
    for i, result in enumerate(results):
        if result.covariance is None:
            raise ValueError(f"results[{i}] has no intervals: {result.without_intervals}")
    fitted = [{name for name, one in each.parameters.items() if one.has_interval or one.effective} for each in results]
    estimates = [_estimates(result) for result in results]
    found = {}
    for name in (name for name in results[0].parameters if all(name in own for own in fitted)):
        values, variances, degrees = np.array([own[name] for own in estimates]).T
        centre, away = combined(values, variances, level, min(degrees))
        value, unit = _at(results[0], name, centre), results[0].parameters[name].unit
        low, high = sorted(_at(results[0], name, end) for end in (centre - away, centre + away))
        reasons = [why for each in results if (why := each.parameters[name].effective)]
        most = 2 * len(reasons) > len(results)
        found[name] = Parameter(value, unit=unit, effective=reasons[0]) if most else Parameter(value, low, high, unit)
    return found


def combined(
    estimates: Float[np.ndarray, " m"], variances: Float[np.ndarray, " m"], level: float = 0.95, degrees: float = np.inf
) -> tuple[float, float]:
    """Return the mean of m estimates and the half-width of its interval, given their variances (Rubin, Eq. 3.1.2–8).

    Degrees of freedom follow Barnard and Rubin (Biometrika 1999): at least m − 1, or `degrees` if that is less.
    """
    m = len(estimates)
    between = (1 + 1 / m) * np.var(estimates, ddof=1)
    total = np.mean(variances) + between
    share = between / total
    # Inverse degrees of freedom of the variances between and within the estimates.
    ours = share**2 / (m - 1)
    own = (degrees + 3) / (degrees + 1) / degrees / (1 - share) if np.isfinite(degrees) and share < 1 else 0.0
    freedom = max(1 / (ours + own), min(m - 1, degrees)) if ours + own > 0 else np.inf
    return float(np.mean(estimates)), float(scipy.special.stdtrit(freedom, (1 + level) / 2) * np.sqrt(total))


def satterthwaite(variances: Float[np.ndarray, "c p"], degrees: Float[np.ndarray, " c"]) -> Float[np.ndarray, " p"]:
    """Compute the effective degrees of freedom of a sum of c independent estimates of variance; ∞ for a known one.

    An estimate v of a variance σ² with ν degrees of freedom is σ² χ²_ν / ν: its mean is σ², its variance 2 σ⁴ / ν. The
    sum Σ v_i thus has the mean Σ σ_i² and the variance Σ 2 σ_i⁴ / ν_i. Student's quantile is right for a multiple of
    χ²_ν with these two moments: with v_i for σ_i², ν = (Σ v_i)² / Σ (v_i² / ν_i) (Satterthwaite, Biometrics Bulletin
    1946; Welch, Biometrika 1947; ISO/IEC Guide 98-3, GUM, Sec. G.4.1). It is between the smallest ν_i and Σ ν_i.
    """
    total = np.sum(variances, axis=0)
    shares = np.divide(variances, total, out=np.ones_like(variances), where=np.isfinite(total) & (total > 0))
    with np.errstate(divide="ignore"):
        return 1 / np.sum(np.square(shares) / np.asarray(degrees)[:, None], axis=0)


def _estimates(result: Adaptation) -> dict[str, tuple[float, float, float]]:
    """Return each parameter's value, variance and degrees of freedom by name."""
    theta, _ = ravel_parameters(result.field)
    assert result.covariance is not None
    assert result.degrees is not None
    known = zip(theta.tolist(), np.diag(result.covariance).tolist(), result.degrees.tolist(), strict=True)
    return dict(zip(named_parameters(result.field), known, strict=True))


def _at(result: Adaptation, name: str, value: float) -> float:
    theta, unravel = ravel_parameters(result.field)
    return float(named_parameters(unravel(theta.at[[*result.parameters].index(name)].set(value)))[name])
