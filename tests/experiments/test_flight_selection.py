"""The choice by flights that were left out of training: laws on made-up scores, and which flights are left out."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import CONFIG, LOGS, OTHERS, samples

from experiments.real_flight.folds import Fold, leave_out, make_folds, motion_of_logs, require_windows
from experiments.real_flight.report import expected_table, warnings_of
from experiments.real_flight.selection import Candidate, Selection
from experiments.real_flight.study import candidates, recipe_of
from hybrid_jax.cli.choice import choose, expected, undecided
from hybrid_jax.extrapolation import WARN, shares_outside
from hybrid_jax.flights.windows import cut_windows, flight_of, manoeuvre_of

SIMPLE = ("hold", "thrust")
GOOD = [-0.5, -0.4, -0.6, -0.5]
STAGED, TURNING = Candidate("hybrid", "staged"), Candidate("hybrid", "turning")


def scores(seeds=2, **flights):
    """Scores of the baselines, and of further candidates by flight."""
    every = {"hold": [1.0, 1.2, 0.9, 1.1], "thrust": [0.0] * 4} | flights
    return {name: np.repeat(np.array(each, float)[:, None], seeds, axis=1) for name, each in every.items()}


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
    assert choose(scores(**learned), SIMPLE) == chosen
    moved = {name: each + np.array([[0.3], [-0.2], [0.1], [0.5]]) for name, each in scores(**learned).items()}
    assert choose(moved, SIMPLE) == chosen  # how hard a flight is does not matter


def test_a_baseline_that_fails_on_a_flight_excuses_no_other():
    found = scores(linear=[-0.9, -0.9, -0.9, 0.5], a=[-0.9, -0.9, -0.9, 0.2], b=GOOD)
    assert choose(found, ("linear", *SIMPLE)) == "b"


def test_seeds_alone_excuse_a_worse_flight():
    found = scores(a=[-0.5, -0.5, -0.5, 0.02])
    assert choose(found, SIMPLE) == "thrust"
    found["a"][3] += (-0.1, 0.1)
    assert choose(found, SIMPLE) == "a"


def test_learned_candidates_that_are_not_told_apart_are_blended():
    close = {"a": GOOD, "b": [-0.6, -0.38, -0.61, -0.43]}
    assert sorted(undecided(scores(**close), SIMPLE)) == ["a", "b"]
    assert undecided(scores(a=GOOD), SIMPLE) == []
    assert undecided(scores(a=GOOD, b=[-0.1, -0.2, -0.1, -0.1]), SIMPLE) == []
    both = scores(**close) | {"a + b": scores(a=GOOD)["a"] - 0.3}
    assert choose(both, SIMPLE) == "a + b"


def test_a_baseline_is_mostly_taken_where_others_are_better_by_chance():
    rng = np.random.default_rng(0)
    taken = []
    for _ in range(200):
        noise = {f"m{i}": rng.normal(0.1, 0.3, 4) for i in range(5)}
        taken.append(choose(scores(**noise), SIMPLE))
    assert np.mean([name in SIMPLE for name in taken]) > 0.6


@pytest.mark.parametrize("flights", [2, 3, 7])
def test_interval_holds_another_flight_in_eight_of_ten_cases(flights):
    logs = np.random.default_rng(1).normal(-3, 0.4, (4000, flights + 1))
    _, low, high = np.transpose([expected(each[:-1]) for each in logs])
    assert np.mean((low < np.exp(logs[:, -1])) & (np.exp(logs[:, -1]) < high)) == pytest.approx(0.8, abs=0.02)


def test_one_flight_bounds_nothing():
    value, low, high = expected(np.log([[2.0]]))
    assert (value[0], low[0], high[0]) == (pytest.approx(2.0), 0.0, np.inf)


@pytest.mark.parametrize("by", ["flight", "manoeuvre"])
def test_every_flight_is_left_out_once_and_shares_no_sample_with_training(by):
    config, of = replace(CONFIG, validate_by=by), {"flight": flight_of, "manoeuvre": manoeuvre_of}[by]
    (fold,) = make_folds(LOGS, OTHERS, config)
    inner = leave_out(fold, config)
    assert sorted(log.name for each in inner for log in each.test) == sorted(log.name for log in LOGS)
    assert len(inner) == {"flight": 5, "manoeuvre": 3}[by]
    for each in inner:
        parts = [{of(log) for log in part} for part in (each.train, each.validation, each.test)]
        assert not parts[0] & parts[2]
        assert not parts[1] & parts[2]
        learned, left_out = (samples(cut_windows(part, 5).windows) for part in (each.train, each.test))
        assert not learned & left_out


def test_the_last_flight_stops_its_own_training():
    for each in leave_out(Fold("", LOGS[:1], LOGS[1:2], OTHERS), CONFIG):
        ((train,), (validation,), (test,)) = each.train, each.validation, each.test
        assert train is validation
        assert train is not test


def test_one_manoeuvre_or_flight_is_refused_with_what_to_do():
    config = replace(CONFIG, validate_by="manoeuvre")
    with pytest.raises(ValueError, match=r"--validate-by manoeuvre: 3 flights of one name .*use --validate-by flight$"):
        make_folds(LOGS[:3], OTHERS, config)
    with pytest.raises(ValueError, match=r"--validate-by flight: 1 flights of one name .*add a flight$"):
        make_folds(LOGS[:1], OTHERS, CONFIG)
    folds = make_folds(LOGS[:3], OTHERS, CONFIG)
    with pytest.raises(ValueError, match=r"--batch-size 100: without chirp_run., the flights have only \d+ windows"):
        require_windows(folds, folds[0], CONFIG)


def test_candidates_are_the_simplest_first():
    config = replace(CONFIG, recipes=("staged", "turning"))
    learned = ["physics_only staged", "hybrid staged", "hybrid turning"]  # of physics alone, both are one
    assert [*map(str, candidates(config))] == ["hold", "thrust", "linear_residual", *learned]


def selected(chosen, **more):
    found = {Candidate(name): each for name, each in scores().items()}
    found |= {STAGED: scores(a=GOOD)["a"], TURNING: scores(a=[2.0] * 4)["a"]}
    return Selection("square", 0, chosen, list("abcd"), found, expected(np.zeros((3, 1, 4))), ["10"], **more)


def test_recipe_of_the_other_models():
    for chosen in (STAGED, Candidate("thrust"), Candidate.blend((STAGED, TURNING))):
        assert recipe_of(selected(chosen), CONFIG) == "staged"


def test_report_says_how_many_flights_came_out_as_expected():
    found = selected(Candidate("thrust"), observed={"a": np.ones((1, 4)), "b": np.full((1, 4), 2.0)})
    np.testing.assert_array_equal(found.inside(), [[1] * 4])
    (line,) = expected_table([found]).lines
    assert line[:4] == ("square", "thrust", "–", "10")
    assert line[4] == "1 [1, 1]: 1.5, 1 of 2"


def test_flights_outside_of_training_are_named():
    same = shares_outside(motion_of_logs(LOGS), motion_of_logs(LOGS))
    assert all(share < 0.03 for share in same.values())
    fast = replace(LOGS[0], x=LOGS[0].x + 30.0 * (np.arange(13) == 7))
    far = shares_outside(motion_of_logs(LOGS), motion_of_logs([fast]))
    assert far["speed [m/s]"] == 1.0
    assert far["tilt [rad]"] < 0.1
    assert set(motion_of_logs(LOGS)) == set(far)
    (line,) = warnings_of({"melon": ("test", far), "chirp": ("test", same)})
    assert "speed [m/s] in 1 of 2 flights, most in melon (100% of its samples)" in line
    assert "tilt" not in line
    assert warnings_of({"chirp": ("test", same)}) == []
    assert WARN > 0.02
