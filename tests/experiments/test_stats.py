"""Paired comparisons: intervals have their nominal coverage, and limits are exact."""

import math

import numpy as np
import pytest

from experiments.reporting.results import mean_difference, share_of_gap

REPEATS, SEEDS = 2000, 10


@pytest.mark.parametrize("share", [0.0, 0.9, 1.3])
def test_coverage_of_share_of_gap(share):
    """Before varies between seeds, after follows it with noise of its own; Fieller's interval is exact for normals."""
    rng = np.random.default_rng(0)
    before = rng.normal(3.0, 0.5, (REPEATS, SEEDS))
    after = before - share * (before - 1.0) + rng.normal(0.0, 0.2, before.shape)
    found = [share_of_gap(b, a, np.ones(SEEDS)) for b, a in zip(before, after, strict=True)]
    held = np.mean([interval.low <= share <= interval.high for interval in found])
    # Of 2000 the share is known to 0.5 %; the limits are three of these off.
    assert held == pytest.approx(0.95, abs=0.015)
    assert np.mean([interval.value for interval in found]) == pytest.approx(share, abs=0.01)


def test_coverage_of_mean_difference():
    rng = np.random.default_rng(1)
    shared = rng.normal(0.0, 5.0, (REPEATS, SEEDS))
    found = [mean_difference(base + rng.normal(1.0, 0.3, SEEDS), base + rng.normal(0.6, 0.3, SEEDS)) for base in shared]
    assert np.mean([interval.low <= 0.4 <= interval.high for interval in found]) == pytest.approx(0.95, abs=0.015)
    # What the pair shares, ten times larger, is not in the interval.
    assert np.mean([interval.high - interval.low for interval in found]) < 1.0


def test_share_of_gap_is_one_at_the_reachable_and_zero_before():
    before, reachable = np.array([4.0, 5.0, 6.0]), np.ones(3)
    assert share_of_gap(before, reachable, reachable) == pytest.approx((1.0, 1.0, 1.0))
    assert share_of_gap(before, before, reachable) == pytest.approx((0.0, 0.0, 0.0))


def test_share_without_significant_gap_has_no_ends():
    unsure = share_of_gap([1.2, 0.9, 1.1], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    assert unsure.value == pytest.approx(1.0)
    assert math.isnan(unsure.low)
    assert math.isnan(unsure.high)
    assert math.isnan(share_of_gap([0.9, 0.8], [0.9, 0.8], [1.0, 1.0]).value)


def test_failed_seeds_are_left_out():
    whole = share_of_gap([4.0, 5.0, 6.0], [1.5, 1.4, 1.6], [1.0] * 3)
    assert share_of_gap([4.0, 5.0, 6.0, 7.0], [1.5, 1.4, 1.6, math.inf], [1.0] * 4) == pytest.approx(whole)
    assert mean_difference([1.0, math.inf, 3.0], [0.5, 1.0, 2.0]).value == pytest.approx(0.75)
    single = mean_difference([1.0], [0.25])
    assert single.value == 0.75
    assert math.isnan(single.low)


def test_samples_of_other_seeds_are_refused():
    with pytest.raises(ValueError, match="same seeds"):
        mean_difference([1.0, 2.0], [1.0])
