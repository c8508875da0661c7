"""The comparison of a designed flight with others: its verdicts and tables, and the command."""

import json
import math

import numpy as np
import pytest
from smoke import experiments, refused, unbegun

from experiments.excitation.results import (
    CLAIMS,
    DESIGNED,
    FLIGHTS,
    RANDOM,
    Evidence,
    conclusion,
    margins,
    ratio,
    tables,
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
    halves, inside = evaluate(CLAIMS, Evidence(rows(share), INSIDE))
    assert halves.holds is holds
    assert inside.holds


def test_a_flight_that_leaves_a_limit_is_said_to():
    _, inside = evaluate(CLAIMS, Evidence(rows(0.3), INSIDE | {"z [m]": (1.3, 1.25)}))
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


def test_an_interval_that_says_nothing_is_shown_as_wide():
    wide = Results([{**row, "half_width": math.inf} for row in rows(0.3, 1)], ("flight", "parameter", "seed"))
    assert all("> 1000" in line[1:] for line in tables(wide)[0].lines)


def test_beside_an_unbounded_interval_any_other_is_nothing():
    given = Results([{**row, "half_width": math.inf if row["flight"] == "hover" else 1.0} for row in rows(0.3)])
    assert ratio(given, "hover").value == 0
    assert "more than 1000 times narrower than after hover" in conclusion(given)[0]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--change", "rain"], "--change must be one of source, parameter_shift"),
        (["--noise", "0"], "--noise must be above 0"),
        (["--seconds", "30"], "--seconds must be from 3 to 11"),
        (["--parameters", "k", "k"], "--parameters must be at least one, each different"),
        (["--bounds.low", "0", "0", "5"], "low must be below high, else the box is empty"),
    ],
)
def test_bad_options_are_refused(options, said):
    assert said in refused(unbegun("excitation", *options), "excitation")


@pytest.mark.slow
def test_the_command_writes_a_row_for_every_flight_parameter_and_seed(tmp_path):
    (run,) = experiments("excitation", "excitation", folder=tmp_path)
    assert run.returncode == 0, run.stderr
    out = tmp_path / "out" / "excitation"
    report = json.loads((out / "report.json").read_text())
    assert len(report["rows"]) == len(FLIGHTS) * 3 * 2  # parameters, seeds
    assert min(report["design"]["margins"].values()) >= 0
    assert all((out / name).stat().st_size for name in report["figures"])
