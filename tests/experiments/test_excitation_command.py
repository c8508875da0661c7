"""The comparison of a designed flight with others: its verdicts and tables, and the command."""

import math

import numpy as np
import pytest

from experiments.excitation.results import (
    CLAIMS,
    DESIGNED,
    FLIGHTS,
    RANDOM,
    DesignEvidence,
    margins,
    ratio,
)
from experiments.reporting.claims import evaluate
from experiments.reporting.results import Results
from hybrid_jax.planning import FlightBounds

INSIDE = {"tilt [rad]": (0.5, 0.6)}


def rows(share, seeds=5):
    """The designed flight's widest interval, that of k, is about this share of the random one's; Ix is told better."""
    found = []
    for seed in range(seeds):
        for flight in FLIGHTS:
            wide = 2.0 * (share if flight == DESIGNED else 1.0) * (1 + 0.02 * seed * (flight == RANDOM))
            for name, width in {"Ix": 0.1 * wide, "k": wide}.items():
                numbers = {"half_width": width, "predicted": width, "error": 0.1, "inside": True}
                found.append({"flight": flight, "parameter": name, "seed": seed, "draw": None} | numbers)
    return Results(found, ("flight", "parameter", "seed"))


@pytest.mark.parametrize(("share", "holds"), [(0.3, True), (0.52, None), (0.8, False)])
def test_the_worst_parameter_decides(share, holds):
    assert ratio(rows(share), RANDOM).value == pytest.approx(share, rel=0.1)
    halves, inside = evaluate(CLAIMS, DesignEvidence(rows(share), INSIDE))
    assert halves.holds is holds
    assert inside.holds


def test_a_flight_that_leaves_a_limit_is_said_to():
    _, inside = evaluate(CLAIMS, DesignEvidence(rows(0.3), INSIDE | {"z [m]": (1.3, 1.25)}))
    assert inside.holds is False
    assert "z [m] 1.30 of 1.2" in inside.measured


def test_margins_are_measured_from_the_middle_of_the_box():
    """Hover a metre below the middle, then a tilt of 0.3 rad about x at 2 m/s."""
    states = np.zeros((2, 13), np.float32)
    states[:, 2] = 1.75, 0.75
    states[:, 3:5] = (1, 0), (math.cos(0.15), math.sin(0.15))
    states[1, 7] = 2.0
    found = margins(FlightBounds(), states)
    assert found["z [m]"] == pytest.approx((1.0, 1.25))
    assert found["tilt [rad]"] == pytest.approx((0.3, 0.6), rel=1e-3)
    assert found["speed [m/s]"] == pytest.approx((2.0, 4.0))
    assert found["yaw [rad]"][0] == pytest.approx(0, abs=1e-6)
