"""Tables, hypotheses and figures of closed-loop flight, on rows with known numbers."""

import math
from dataclasses import asdict

import pytest

from experiments.closed_loop.claims import FlightEvidence, Speed, claims
from experiments.closed_loop.results import ERROR, TAGS, Agent
from experiments.flying.scenario import REFERENCES
from experiments.reporting.claims import evaluate
from experiments.reporting.results import Results

FEW, SEEDS = 100, 3
AGENTS = {  # position RMSE [m] with the other inertia and in the wind
    Agent("nominal"): (0.1, 0.4),
    Agent("oracle"): (0.01, 0.05),
    Agent("hybrid"): (0.02, 0.4),
    Agent("hybrid", FEW): (0.015, 0.07),
    Agent("hybrid", observer=True): (0.016, 0.08),
    Agent("hybrid", FEW, observer=True): (0.012, 0.06),
    Agent("invariant"): (0.02, 0.4),
    Agent("invariant", observer=True): (0.016, 0.08),
    Agent("invariant", FEW): (0.011, 0.055),
    Agent("invariant", FEW, observer=True): (0.0105, 0.052),
    Agent("least_squares", FEW): (0.0115, 0.0545),
    Agent("least_squares", FEW, observer=True): (0.0106, 0.0515),
}
SPEED = Speed(1.2, 1.4, 3600.0, 100.0, 190.0, 2)


def make_rows(reference="hover", distance=0.0):
    """The seeds of trained models are 1 % apart."""
    return [
        {
            "domain": domain, **asdict(agent), "reference": reference, "distance": distance, "seed": seed,
            "position_rmse": mean * (1 + 0.01 * seed), "yaw_rmse": 0.01, "largest_error": 2 * mean, "crashed": False,
            "saturation": 0.0, "promised": 1.0, "realised": 1.05, "excess": 0.05,
        }
        for agent, means in AGENTS.items()
        for domain, mean in zip(("parameter_shift", "external_force"), means, strict=True)
        for seed in range(1 if agent.model in ("nominal", "oracle") else SEEDS)
    ]  # fmt: skip


ROWS = Results([row for reference in REFERENCES for row in make_rows(reference)] + make_rows(distance=60.0), TAGS)
WORSE_AWAY = Results([{**row, "position_rmse": row["position_rmse"] * (1.2 if row["distance"] else 1)} for row in ROWS])


def changed(rows, agent, domain="external_force", reference="hover", **values):
    place = {"domain": domain, "reference": reference, **asdict(agent)}
    return Results([{**row, **values} if place.items() <= row.items() else row for row in rows], TAGS)


def verdicts(rows, speed=SPEED):
    return {verdict.id: verdict for verdict in evaluate(claims(FEW), FlightEvidence(rows, speed))}


def holds(*evidence):
    return {name: verdict.holds for name, verdict in verdicts(*evidence).items()}


def test_a_crash_counts_as_an_infinite_error():
    results = Results([{**ROWS[0], "position_rmse": math.nan}, {**ROWS[0], "crashed": True, "seed": 1}], TAGS)
    assert results.numbers(ERROR).tolist() == [math.inf] * 2


def test_all_hypotheses_hold_on_these_rows():
    assert list(holds(ROWS).values()) == [True] * (3 * 7 + 2)


@pytest.mark.parametrize(
    ("goal", "rows"),
    [
        ("R1a", changed(ROWS, Agent("hybrid", FEW), position_rmse=0.11)),
        ("R1b", changed(ROWS, Agent("invariant", FEW), crashed=True)),
        ("R2a", changed(ROWS, Agent("hybrid", FEW), position_rmse=0.09)),
        ("R3a", changed(ROWS, Agent("hybrid", FEW), "parameter_shift", "upset", position_rmse=0.021)),
        ("R3c", changed(ROWS, Agent("least_squares", FEW), "parameter_shift", "step", position_rmse=0.021)),
        ("R4b", changed(ROWS, Agent("invariant", FEW), "parameter_shift", "step", excess=0.11)),
        ("R4a", changed(ROWS, Agent("hybrid", FEW), "parameter_shift", "step", excess=-0.11)),
        ("R5a", changed(ROWS, Agent("hybrid", FEW, observer=True), position_rmse=0.075)),
        ("R5b", changed(ROWS, Agent("invariant", FEW, observer=True), position_rmse=0.058)),
        ("R9b", changed(ROWS, Agent("invariant", FEW, observer=True), "parameter_shift", "upset", position_rmse=0.017)),
        ("R6b", WORSE_AWAY),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_one_missed_goal_fails_only_its_hypothesis(goal, rows):
    failed = {name for name, outcome in holds(rows).items() if outcome is False}
    # A larger error in the wind also leaves more of the gap; a smaller one at home is a larger ratio away from it.
    also = {"R2a", "R2b", "R2c", "R1a", "R1b", "R1c"} if goal.startswith("R1") else {"R6a", "R6b", "R6c"}
    assert goal in failed
    assert failed <= {goal, *also}


def test_hypotheses_are_undecided_within_the_noise_of_the_seeds():
    """The adapted models differ twentyfold between seeds, with the observer in another order than without."""

    def noisy(row):
        if not row["n_train"] or row["distance"]:
            return row
        factor = (0.2, 1.0, 4.0)[(row["seed"] + row["observer"]) % SEEDS]
        return {**row, "position_rmse": row["position_rmse"] * factor, "excess": 0.05 * (factor - 0.2)}

    found = verdicts(Results([noisy(row) for row in ROWS], TAGS))
    assert {name for name, verdict in found.items() if verdict.holds is not None} == {"R7", "R8"}
    assert not any(verdict.lacks_data for verdict in found.values())


def test_speed_hypotheses_compare_measured_times():
    slow = holds(ROWS, SPEED._replace(call_ms=1.6, seconds=200.0))
    assert (slow["R7"], slow["R8"]) == (False, False)


def test_missing_flights_are_undecided():
    found = holds(ROWS.where(lambda row: row["reference"] != "low_pass", distance=0.0))
    assert [found[name] for name in ("R1a", "R2a", "R5a", "R6a")] == [None] * 4
    assert found["R3a"] is True
