"""The choice by flights that were left out of training: laws on made-up scores."""

import numpy as np
import pytest

from hybrid_jax.cli.choice import choose, expected

GOOD = [-0.5, -0.4, -0.6, -0.5]


def scores(**flights):
    """Scores of the baseline, and of further candidates by flight."""
    return {name: np.array(each, float) for name, each in ({"thrust": [0.0] * 4} | flights).items()}


@pytest.mark.parametrize(
    ("learned", "chosen"),
    [
        ({"a": GOOD}, "a"),
        ({"a": [0.1, -0.1, 0.2, 0.1]}, "thrust"),  # nothing beats the baseline
        ({"a": [-0.9, -0.9, -0.9, 0.5]}, "thrust"),  # the best on average, terrible on one flight
        ({"a": [-0.9, -0.9, -0.9, 0.5], "b": [-0.1, -0.2, -0.1, -0.1]}, "b"),
        ({"a": GOOD, "b": [-0.52, -0.38, -0.61, -0.49]}, "a"),  # as good as the simpler one
        ({"a": GOOD, "b": [-0.6, -0.5, -0.7, -0.6]}, "b"),  # better on every flight
        ({"a": [np.nan, -2, -2, -2], "b": GOOD}, "b"),
        ({"a": [np.inf] * 4}, "thrust"),
    ],
)
def test_choice(learned, chosen):
    assert choose(scores(**learned)) == chosen
    moved = {name: each + np.array([0.3, -0.2, 0.1, 0.5]) for name, each in scores(**learned).items()}
    assert choose(moved) == chosen  # how hard a flight is does not matter


def test_a_baseline_is_mostly_taken_where_others_are_better_by_chance():
    rng = np.random.default_rng(0)
    taken = [choose(scores(**{f"m{i}": rng.normal(0.1, 0.3, 4) for i in range(5)})) for _ in range(200)]
    assert np.mean([name == "thrust" for name in taken]) > 0.6


@pytest.mark.parametrize("flights", [2, 3, 7])
def test_interval_holds_another_flight_in_eight_of_ten_cases(flights):
    logs = np.random.default_rng(1).normal(-3, 0.4, (4000, flights + 1))
    _, low, high = np.transpose([expected(each[:-1]) for each in logs])
    assert np.mean((low < np.exp(logs[:, -1])) & (np.exp(logs[:, -1]) < high)) == pytest.approx(0.8, abs=0.02)


def test_one_flight_bounds_nothing():
    value, low, high = expected(np.log([[2.0]]))
    assert (value[0], low[0], high[0]) == (pytest.approx(2.0), 0.0, np.inf)
