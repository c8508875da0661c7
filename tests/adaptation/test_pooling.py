"""Laws of combining several sources' estimates."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from pendulum import LENGTH, Push, pendulum, pushes, swings
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.adaptation.pooling import combined, satterthwaite
from hybrid_jax.adaptation.results import Parameter


def test_the_interval_holds_errors_within_and_between_sources():
    """The truth is one more draw from where the sources' estimates lie, and all share the noise of the windows."""
    rng = np.random.default_rng(0)
    noise, draws = 0.1 * rng.normal(size=2000), 0.3 * rng.normal(size=(2000, 5))
    found = [combined(own[1:] + shared, np.full(4, 0.1**2)) for shared, own in zip(noise, draws, strict=True)]
    held = [abs(centre - own[0]) <= away for (centre, away), own in zip(found, draws, strict=True)]
    assert np.mean(held) == pytest.approx(0.95, abs=0.02)


def test_sources_that_differ_widen_the_interval():
    exact = swings(40, damping=0.0)
    noise = 0.02 * np.random.default_rng(0).normal(size=exact.x.shape).astype(np.float32)
    windows = replace(exact, x=np.asarray(exact.x) + noise)
    sources = [hj.Hybrid(pendulum(0.7), Bias(np.float32(bias))) for bias in (-0.05, 0.0, 0.06)]
    results = [hj.adapt(source, windows, method="theta_least_squares") for source in sources]
    pooled, alone = hj.pool(results)["log_length"], results[1].parameters["log_length"]
    assert pooled.low < np.log(LENGTH) < pooled.high
    assert pooled.high - pooled.low > 1.5 * (alone.high - alone.low)
    shared = hj.pool([replace(each, covariance=1e4 * each.covariance) for each in results])["log_length"]
    assert shared.high - shared.low > 50 * (alone.high - alone.low)  # all may have absorbed the same
    assert pooled.value == pytest.approx(np.mean([each.parameters["log_length"].value for each in results]), abs=1e-5)
    effective = [{"log_length": replace(each.parameters["log_length"], effective="why")} for each in results]
    most = [replace(each, parameters=own) for each, own in zip(results[:2], effective, strict=False)]
    assert hj.pool([*most, results[2]])["log_length"] == Parameter(pooled.value, effective="why")
    assert hj.pool([most[0], *results[1:]])["log_length"] == pooled


class Bias(hj.AbstractVectorField):
    rate: np.ndarray

    def __call__(self, x, u):
        return self.rate * np.array([0.0, 1.0], np.float32) * x


def test_two_sources_or_one_without_intervals_are_refused():
    results = [hj.adapt(pendulum(), swings(40), method="theta_least_squares")] * 3
    refusal(lambda: hj.pool(results[:2]), "results must come from at least 3 source models, got 2")
    refusal(lambda: hj.pool(results[0]), "results must be a list of Adaptation, got Adaptation")
    tuned = hj.adapt(pendulum(), swings(40), method=hj.FineTune(max_epochs=1))
    with pytest.raises(ValueError, match=r"results\[2\] has no intervals: they are valid for least squares only"):
        hj.pool([*results[:2], tuned])


@pytest.mark.parametrize("of_target", [0.1, 0.3, 0.5, 0.9])
def test_intervals_hold_if_a_part_of_the_variance_is_known_better_than_the_rest(of_target):
    """Of the variance a share is the target's, known from five blocks, and the rest the source's, from a hundred."""
    rng, shares, freedom = np.random.default_rng(0), np.array([of_target, 1 - of_target]), np.array([4.0, 99.0])
    error = rng.normal(size=5000)
    found = shares[:, None] * rng.chisquare(freedom[:, None], (2, 5000)) / freedom[:, None]
    degrees = satterthwaite(found, freedom)
    within = np.abs(error) / np.sqrt(found.sum(axis=0)) <= scipy.stats.t.ppf(0.975, degrees)
    assert np.mean(within) == pytest.approx(0.95, abs=0.012)  # four standard deviations of the mean
    assert freedom[0] <= degrees.min()
    assert degrees.max() <= freedom.sum()


def test_few_degrees_of_freedom_widen_the_interval_and_a_parameter_that_is_not_determined_has_some():
    """Of equal estimates it is Student's, but for the correction of Barnard and Rubin."""
    found = satterthwaite(np.array([[np.inf, 0.0, 1.0], [1.0, 0.0, 0.0]]), np.array([4.0, np.inf]))
    np.testing.assert_allclose(found, [4.0, 4.0, 4.0])
    wide, narrow = (combined(np.full(3, 2.0), np.full(3, 0.25), degrees=degrees)[1] for degrees in (9, np.inf))
    assert 2.26 / 1.96 * narrow < wide < 1.4 * narrow
    # Hardly any variance within: it is Student's interval of the estimates alone, also with few blocks of windows.
    _, away = combined(np.array([1.0, 2.0, 3.0]), np.full(3, 1e-9), degrees=9)
    assert away == pytest.approx(scipy.stats.t.ppf(0.975, 2) * np.sqrt(4 / 3), rel=1e-6)


def test_the_variance_of_clusters_is_that_of_leaving_each_out():
    """Of a linear model, fitted anew without each of four clusters of different sizes."""
    windows, design = pushes(35, noise=0.1)
    of = np.arange(35) // 10
    field = hj.fit_least_squares(Push(np.zeros(2, np.float32)), windows).field
    data = np.asarray(windows.x).reshape(35, -1)
    refits = [np.linalg.lstsq(design[of != g].reshape(-1, 2), data[of != g].ravel())[0] for g in range(4)]
    expected = 3 * np.cov(np.array(refits).T, ddof=0)
    np.testing.assert_allclose(hj.covariance_of(field, windows, cluster=10), expected, rtol=1e-3)
