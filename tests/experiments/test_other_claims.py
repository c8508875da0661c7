"""Claims about what the windows choose, about intervals, and about a designed flight."""

import math

import numpy as np
import pytest

from experiments import coverage
from experiments.excitation import results as design
from experiments.paper import regret
from experiments.reporting.claims import evaluate
from experiments.reporting.results import Results
from hybrid_jax.adaptation.results import Parameter
from hybrid_jax.planning import FlightBounds


def choices(taken="theta", theta=0.05, force=0.06, fine_tune=0.5, inside=0.8):
    """Ten seeds and four draws in both experiments of the paper; the source errs by 1."""
    found = []
    for domain in ("parameter_shift", "external_force"):
        for draw, seed in np.ndindex(4, 9):
            errors = {"source": 1.0, "theta": theta, "force": force, "fine_tune": fine_tune}
            for name, error in errors.items():
                candidate = {"taken": name == taken, "expected_inside": inside if name == taken else None}
                tags = {
                    "world": "iris",
                    "domain": domain,
                    "candidate": name,
                    "draw": draw,
                    "seed": seed,
                    "test_mse": error,
                }
                found.append(tags | candidate)
    return Results(found, regret.TAGS)


@pytest.mark.parametrize(
    ("change", "fails"),
    [
        ({}, []),
        ({"force": 0.04}, ["A1"]),  # the best in hindsight is a fifth better
        ({"taken": "force", "force": 0.2}, ["A1", "A3"]),
        ({"theta": 1.05, "force": 1.05, "fine_tune": 2.0}, ["A2", "A3"]),
        ({"fine_tune": 0.049}, ["A4"]),
        ({"inside": 0.5}, ["A5"]),
        ({"inside": 0.98}, ["A5"]),
    ],
)
def test_each_claim_about_choices_fails_where_it_should(change, fails):
    found = {each.id: each.holds for each in evaluate(regret.CLAIMS, choices(**change))}
    assert [id for id, holds in found.items() if not holds] == fails


def test_regret_counts_candidates_alone():
    np.testing.assert_allclose(regret.regret(choices(fine_tune=0.01)), 1.0)  # fine-tuning is no candidate
    np.testing.assert_allclose(regret.regret(choices(taken="force")), 0.06 / 0.05)


def intervals(inside, flights=100, half_width=2.0):
    """Of each flight whether the interval of Ix contains the truth; k was not fitted."""
    found = []
    for draw in range(flights):
        tags = {"world": "iris", "domain": "weak_rotor", "noise": "1", "draw": draw}
        numbers = {"inside": draw < inside, "error": 1.6, "half_width": half_width, "alone": 0.5}
        found += [tags | {"parameter": "Ix"} | numbers, tags | {"parameter": "k"} | dict.fromkeys(numbers)]
    return Results(found, ("world", "domain", "noise", "draw", "parameter"))


FEWER = [({"inside": inside}, holds) for inside, holds in ((97, True), (90, True), (88, None), (80, False))]
# All of 30 hold by chance where 95 % should.
WIDER = [({"inside": 100}, False), ({"half_width": 4.0}, False), ({"inside": 30, "flights": 30}, True)]


@pytest.mark.parametrize(("change", "holds"), FEWER + WIDER)
def test_the_claim_about_intervals_fails_where_significantly_fewer_intervals_hold_or_they_are_too_wide(change, holds):
    (verdict,) = evaluate(coverage.CLAIMS, intervals(**{"inside": 97} | change))
    assert verdict.holds is holds


def test_single_intervals_count_where_a_parameter_is_physical_and_the_truth_divides_errors():
    own, pooled = (
        [Parameter(2.0, 1.5, 2.5), Parameter(3.0, 2.5, 3.5), Parameter(4.0, effective="because")],
        Parameter(3.0, 2.0, 4.0),
    )
    found = coverage._compared(pooled, own, 2.5)
    assert found == {"inside": True, "error": pytest.approx(20), "half_width": 40, "alone": 1.0, "effective": 1}
    assert [coverage._compared(pooled, part, at)["alone"] for part, at in ((own, 1.6), (own[2:], 4.5))] == [0.5, None]
    assert set(coverage._compared(None, own, 2.5).values()) == {None}


INSIDE = {"tilt [rad]": (0.5, 0.6)}


def half_widths(share, seeds=5):
    """The designed flight's widest interval, that of k, is about this share of the random one's; Ix is told better."""
    found = []
    for seed in range(seeds):
        for flight in design.FLIGHTS:
            wide = 2.0 * (share if flight == design.DESIGNED else 1.0) * (1 + 0.02 * seed * (flight == design.RANDOM))
            for name, width in {"Ix": 0.1 * wide, "k": wide}.items():
                numbers = {"half_width": width, "predicted": width, "error": 0.1, "inside": True}
                found.append({"flight": flight, "parameter": name, "seed": seed, "draw": None} | numbers)
    return Results(found, ("flight", "parameter", "seed"))


@pytest.mark.parametrize(("share", "holds"), [(0.3, True), (0.52, None), (0.8, False)])
def test_the_worst_parameter_decides(share, holds):
    assert design.ratio(half_widths(share), design.RANDOM).value == pytest.approx(share, rel=0.1)
    halves, inside = evaluate(design.CLAIMS, design.DesignEvidence(half_widths(share), INSIDE))
    assert halves.holds is holds
    assert inside.holds


def test_a_flight_that_leaves_a_limit_is_said_to():
    _, inside = evaluate(design.CLAIMS, design.DesignEvidence(half_widths(0.3), INSIDE | {"z [m]": (1.3, 1.25)}))
    assert inside.holds is False
    assert "z [m] 1.30 of 1.2" in inside.measured


def test_margins_are_measured_from_the_middle_of_the_box():
    """Hover a metre below the middle, then a tilt of 0.3 rad about x at 2 m/s."""
    states = np.zeros((2, 13), np.float32)
    states[:, 2] = 1.75, 0.75
    states[:, 3:5] = (1, 0), (math.cos(0.15), math.sin(0.15))
    states[1, 7] = 2.0
    found = design.margins(FlightBounds(), states)
    assert found["z [m]"] == pytest.approx((1.0, 1.25))
    assert found["tilt [rad]"] == pytest.approx((0.3, 0.6), rel=1e-3)
    assert found["speed [m/s]"] == pytest.approx((2.0, 4.0))
    assert found["yaw [rad]"][0] == pytest.approx(0, abs=1e-6)
