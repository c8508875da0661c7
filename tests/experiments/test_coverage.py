"""Coverage of intervals pooled over sources, and the command that measures it."""

import numpy as np
import pytest

from experiments.coverage import CLAIMS, _compared
from experiments.reporting.claims import evaluate
from experiments.reporting.results import Results


def rows(inside, flights=100, half_width=2.0):
    """Of each flight whether the interval of Ix contains the truth; k was not fitted."""
    found = []
    for draw in range(flights):
        tags = {"domain": "weak_rotor", "noise": "1", "draw": draw}
        numbers = {"inside": draw < inside, "error": 1.6, "half_width": half_width, "alone": 0.5}
        found += [tags | {"parameter": "Ix"} | numbers, tags | {"parameter": "k"} | dict.fromkeys(numbers)]
    return Results(found, ("domain", "noise", "draw", "parameter"))


@pytest.mark.parametrize(("inside", "holds"), [(97, True), (90, True), (88, None), (80, False)])
def test_the_claim_fails_where_significantly_fewer_intervals_hold(inside, holds):
    (verdict,) = evaluate(CLAIMS, rows(inside))
    assert verdict.holds is holds
    measured = f"Ix, one rotor 15 % weaker, noise {inside / 100:.2f} of 100, 1.2 times as wide as needed"
    assert verdict.measured == measured


@pytest.mark.parametrize(
    ("change", "holds"), [({"inside": 100}, False), ({"half_width": 4.0}, False), ({"inside": 30, "flights": 30}, True)]
)
def test_the_claim_fails_from_above_where_intervals_are_too_wide(change, holds):
    """All of 30 hold by chance where 95 % should."""
    (verdict,) = evaluate(CLAIMS, rows(**{"inside": 97} | change))
    assert verdict.holds is holds


def test_pooled_intervals_have_their_coverage_where_sources_differ_and_single_ones_have_not():
    """Each source absorbed something else: its estimate is off by as much as the flights' noise, and more."""
    rng = np.random.default_rng(0)
    shifts = rng.normal(0, 0.03, (2000, 3))
    found = [_compared(row + rng.normal(0, 0.01), np.full(3, 0.01), 0.0) for row in shifts]
    assert np.mean([row["inside"] for row in found]) > 0.93
    assert np.mean([row["alone"] for row in found]) < 0.75
