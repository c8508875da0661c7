"""Rows: ρ, spread over seeds, what a row refuses, and any JSON in its place."""

import json
import math
from dataclasses import asdict, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reports import ERRORS, changed, make_rows

from experiments.paper.rows import DOMAINS, RIVALS, THETA, from_csv, row_from, to_csv, with_rho
from experiments.paper.summary import grouped, spread, summarise


def test_rho_is_eq_9_of_the_seeds_own_source_only_error():
    for row in make_rows():
        source = ERRORS[row.model, "source_only"][0] * (1 + 0.02 * (row.seed - 1))
        assert row.rho == pytest.approx((source - row.test_mse) / source, rel=1e-12)


def test_rho_needs_a_source_only_row_with_an_error():
    rows = make_rows()
    with pytest.raises(ValueError, match="no source_only row of hybrid, seed 0"):
        with_rho(row for row in rows if row.mode != "source_only")
    with pytest.raises(ValueError, match="test_mse 0"):
        changed(rows, "hybrid", "source_only", 0, test_mse=0.0)


@pytest.mark.parametrize("rival", RIVALS)
def test_rho_of_a_rival_is_its_gain_over_the_hybrid_of_the_same_seed_and_domain(rival):
    here, there = make_rows(), [replace(row, test_mse=row.error / 2) for row in make_rows(domain="external_force")]
    mode, n = ("source_only", 0) if rival == "expert_augmentation" else ("fine_tuned", 100)
    added = [replace(here[0], domain=domain, model=rival, mode=mode, n_train=n, test_mse=0.65) for domain in DOMAINS]
    assert added[0].seed == 0
    gains = [row.rho for row in with_rho([*here, *there, *added]) if row.model == rival]
    source = 2.6 * 0.98
    assert gains == pytest.approx([(source - 0.65) / source, (source / 2 - 0.65) / (source / 2)])


def test_rows_of_two_domains_stand_apart_and_have_no_mean_together():
    both = [*make_rows(), *make_rows(domain="external_force")]
    assert with_rho(both) == both
    with pytest.raises(ValueError, match="one domain, got external_force, parameter_shift"):
        grouped(both)


@pytest.mark.parametrize(
    ("interval", "kept"),
    [([0.039, 0.041], (0.039, 0.041)), ((0.04, 0.04), (0.04, 0.04)), ([math.nan, 1.0], None), (None, None)],
)
def test_an_interval_is_two_finite_ends_or_none(interval, kept):
    row = replace(make_rows()[0], theta_interval=dict.fromkeys(THETA, (0, 1)) | {"Ix": interval})
    assert row.theta_interval == {"Ix": kept, "Iy": (0, 1), "k": (0, 1)}
    assert from_csv(to_csv([row])) == [row] == [row_from(json.loads(json.dumps(asdict(row))))]


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"theta_interval": dict.fromkeys(THETA, (2, 1))}, "low <= high"),
        ({"theta_interval": dict.fromkeys(THETA, (1, 2, 3))}, r"theta_interval\.Ix must be \[low, high\]"),
        ({"theta_interval": {"Ix": [1, 2]}}, "exactly Ix, Iy, k"),
        ({"theta_interval": dict.fromkeys(THETA), "theta": None}, "null where theta is"),
        ({"domain": "source"}, "domain must be one of parameter_shift, external_force"),
    ],
)
def test_a_row_refuses_intervals_and_domains_that_are_none(fields, words):
    with pytest.raises(ValueError, match=words):
        replace(make_rows()[0], **fields)


def test_a_row_that_is_not_finite_counts_as_infinitely_bad():
    rows = changed(make_rows(), "hybrid", "fine_tuned", 100, test_mse=math.nan)
    cell = summarise(rows)["hybrid", "fine_tuned", 100]
    assert (cell.mse.mean, cell.rho.mean, cell.mse.non_finite) == (math.inf, -math.inf, 3)
    assert all(row.test_mse is None and row.rho is None for row in rows if row.error == math.inf)


def test_a_source_only_error_beyond_bounds_makes_any_finite_error_a_full_gain():
    rows = changed(make_rows(), "no_physics", "source_only", 0, test_mse=math.inf)
    assert summarise(rows)["no_physics", "fine_tuned", 100].rho.mean == 1.0


def test_the_standard_deviation_is_that_of_a_sample():
    assert spread([1.0, 2.0, 3.0]).std == pytest.approx(1.0)
    assert math.isnan(spread([1.0]).std)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@settings(deadline=None)
@given(st.sampled_from(range(9)), st.sampled_from(sorted(asdict(make_rows(1)[0]))), JSON)
def test_any_json_in_a_rows_field_is_a_row_or_a_value_error(index, field, value):
    record = asdict(make_rows(1)[index]) | {field: value}
    try:
        row = row_from(record)
    except ValueError as error:
        assert "\n" not in str(error)  # noqa: PT017  either outcome is right
    else:
        assert from_csv(to_csv([row])) == [row]
