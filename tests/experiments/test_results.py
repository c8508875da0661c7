"""The table of results: selection, statistics and files; ρ and cells of the paper's rows."""

import csv
import io
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from reports import ERRORS, ODD_ROWS, changed, make_rows, row

from experiments.paper.lanes import BASELINES, DOMAINS, TAGS, by_domain, cells, gain, with_rho
from experiments.reporting.results import Results


def test_rho_is_eq_9_of_the_seeds_own_source_only_error():
    for each in make_rows():
        source = ERRORS[each["model"], "source_only"][0] * (1 + 0.02 * (each["seed"] - 1))
        assert each["rho"] == pytest.approx((source - each["test_mse"]) / source, rel=1e-12)


def test_rho_needs_a_source_only_row_with_an_error():
    rows = make_rows()
    with pytest.raises(ValueError, match="no source_only row of hybrid, seed 0"):
        with_rho(rows.where(mode=("fine_tuned", "target_only")))
    with pytest.raises(ValueError, match="test_mse 0"):
        changed(rows, "hybrid", "source_only", 0, test_mse=0.0)


@pytest.mark.parametrize("model", BASELINES)
def test_rho_of_a_baseline_is_relative_to_the_hybrid(model):
    mode, n = ("source_only", 0) if model == "expert_augmentation" else ("fine_tuned", 100)
    rows = make_rows() + make_rows(domain="external_force", errors={("hybrid", "source_only"): {0: 1.3}})
    added = with_rho(rows + Results([row(model, mode, n, 0, 0.65, domain) for domain in DOMAINS], TAGS))
    source = 2.6 * 0.98
    expected = [(source - 0.65) / source, (source / 2 - 0.65) / (source / 2)]
    assert added.where(model=model)["rho"] == pytest.approx(expected)


def test_domains_are_separate_and_have_no_mean_together():
    both = make_rows() + make_rows(domain="external_force")
    assert with_rho(both) == both
    assert list(by_domain(both)) == list(DOMAINS)
    with pytest.raises(ValueError, match="one domain, got external_force, parameter_shift"):
        cells(both)


def test_rows_that_are_not_finite_count_as_infinitely_bad():
    rows = changed(make_rows(), "hybrid", "fine_tuned", 100, test_mse=math.nan)
    cell = rows.where(model="hybrid", mode="fine_tuned", n_train=100)
    error, rho = cell.spread("test_mse"), cell.spread(gain)
    assert (error.mean, rho.mean, error.non_finite) == (math.inf, -math.inf, 3)
    assert all(each["test_mse"] is None and each["rho"] is None for each in cell)


def test_pairs_are_of_the_same_seed():
    rows = Results(
        [{"model": m, "seed": s, "error": 10 * s + (m == "b")} for m in "ab" for s in (2, 0, 1)], ("model", "seed")
    )
    first, second = rows.where(model="b"), rows.where(model="a").sort(seed=None)
    np.testing.assert_array_equal(np.subtract(*first.paired(second, "error")), 1)
    np.testing.assert_array_equal(first.paired(second.where(seed=0), "error")[1], 0)  # one model for all seeds
    with pytest.raises(ValueError, match="same seeds, 2 is missing"):
        first.paired(second.where(seed=(0, 1)), "error")


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([{"seed": 0}, {"seed": 0}], "2 rows have seed 0"),
        ([{"model": "a"}], r"rows\[0\] must be an object with seed"),
        ([1], r"rows\[0\] must be an object"),
        ([{"seed": 0, "thing": object()}], "has no JSON form"),
    ],
)
def test_malformed_rows_are_refused(rows, words):
    with pytest.raises(ValueError, match=words):
        Results(rows, ("seed",))


@settings(deadline=None)
@given(ODD_ROWS)
def test_results_round_trip_through_json_and_csv(rows):
    assert Results(json.loads(json.dumps(rows.rows)), rows.tags) == rows
    for each, flat in zip(rows, csv.DictReader(io.StringIO(rows.to_csv())), strict=True):
        for name, value in (each["theta"] or {}).items():
            assert flat[f"theta.{name}"] == ("" if value is None else repr(value))
