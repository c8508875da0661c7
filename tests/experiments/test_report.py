"""Reports: the contract of report.json, the digits of a table, and figures of any rows."""

import csv
import io
import json
import math

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reports import ODD_ROWS, TRUTH, changed, make_report, make_rows

from experiments.paper.claims import DOMAINS_OF
from experiments.paper.figures import ranking, scores
from experiments.paper.lanes import DOMAINS, by_altitude
from experiments.paper.study import placeholder
from experiments.reporting.plots import save_figures
from experiments.reporting.report import write_report
from experiments.reporting.results import Results
from experiments.reporting.tables import measured
from experiments.runner.run_record import PACKAGES
from hybrid_jax.sim.flight import SplitSpec


def test_report_json_keeps_the_contract(tmp_path):
    rows = changed(make_rows(seeds=1), "no_physics", "fine_tuned", 500, test_mse=math.nan, status="diverged")
    rows = rows.where(lambda row: (row["model"], row["mode"]) != ("hybrid", "target_only"))
    write_report(tmp_path, make_report(rows, wind_sine_mse=1e-3, odd=np.array([1.0, math.inf])))
    record = json.loads((tmp_path / "report.json").read_text(), parse_constant=pytest.fail)
    assert {"experiment", "config", "environment", "rows", "claims", "not_judged"} <= set(record)
    assert set(record["environment"]) >= {"versions", "hardware", "seconds"}
    assert set(PACKAGES) < set(record["environment"]["versions"])
    fields = "domain model mode n_train seed test_mse draw rho val_mse epochs status theta"
    assert all(list(row) == fields.split() for row in record["rows"])
    assert any(row["test_mse"] is None and row["rho"] is None for row in record["rows"])
    assert all(set(claim) == {"id", "text", "holds", "measured"} for claim in record["claims"])
    assert {claim["holds"] for claim in record["claims"]} <= {True, False, None}
    assert {claim["id"] for claim in record["not_judged"]} == {"C7"}
    assert all(claim["why"] for claim in record["not_judged"])
    assert (record["format"], record["odd"], record["wind_sine_mse"]) == (2, [1.0, None], 1e-3)
    assert record["truth_theta"] == TRUTH


def test_errors_by_altitude_are_means_over_the_windows_of_each_band():
    windows = placeholder(SplitSpec(3, 10))
    windows.x[..., 2] = [[1.0], [1.0], [0.3]]
    windows.x0[:, 2] = 1.0
    windows.x[1, 4, 2] = 0.6  # the lowest state counts
    errors = np.array([[1.0, 3.0, 5.0], [1.0, 3.0, math.inf]])
    found = by_altitude("test_mse", windows, errors)
    np.testing.assert_array_equal(found["test_mse_high"], [2.0, 2.0])
    np.testing.assert_array_equal(found["test_mse_middle"], [5.0, math.inf])
    assert np.isnan(found["test_mse_low"]).all()


def test_nothing_is_written_if_a_value_has_no_json_form(tmp_path):
    for extra in (object(), "\ud800"):
        with pytest.raises(ValueError):  # noqa: PT011  two refusals, two messages
            write_report(tmp_path / "new", make_report(make_rows(), extra=extra))
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("mean", "std", "text"),
    [(0.0671, 0.0093, "0.067 ± 0.009"), (0.6944, 0.0131, "0.694 ± 0.013"), (22.31, 0.44, "22.3 ± 0.4"),
     (3.21e-4, 2.2e-5, "(3.2 ± 0.2)e-04"), (-0.26, 0.021, "-0.26 ± 0.02"), (0.2, 14.2, "0 ± 14"),
     (2.204, 0.0, "2.2 ± 0"), (2.204, math.nan, "2.2"), (math.inf, 1.0, "inf ± 1")],
)  # fmt: skip
def test_a_mean_ends_with_the_last_digit_that_its_deviation_leaves(mean, std, text):
    assert measured(mean, std) == text


@settings(max_examples=40, deadline=None)
@given(ODD_ROWS, st.sampled_from(sorted(DOMAINS_OF)))
def test_any_rows_make_a_report_that_holds_them(tmp_path_factory, rows, experiment):
    out = tmp_path_factory.mktemp("report")
    write_report(out, make_report(rows, experiment))
    record = json.loads((out / "report.json").read_text())
    assert Results(record["rows"], record["tags"]) == rows
    assert len((out / "rows.csv").read_text().splitlines()) == 1 + len(rows)
    for row, flat in zip(rows, csv.DictReader(io.StringIO(rows.to_csv())), strict=True):
        for name, value in (row["theta"] or {}).items():
            assert flat[f"theta.{name}"] == ("" if value is None else repr(value))


@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(rows=ODD_ROWS, floor=st.floats(0, 1e6))
def test_any_rows_are_drawn(rows, floor):
    own = rows.where(domain=DOMAINS[0])
    if len(rows):
        ranking(rows, "Ranking", {DOMAINS[1]: floor}).savefig(io.BytesIO(), format="png", dpi=30)
    if len(own):
        scores(own, "Scores", floor).savefig(io.BytesIO(), format="png", dpi=30)


def test_figures_are_reproducible_and_keep_matplotlibs_settings(tmp_path):
    before, drawn = (
        dict(mpl.rcParams),
        {name: (scores(make_rows(), "Scores", floor=0.01), "A") for name in ("one", "two")},
    )
    assert save_figures(tmp_path, drawn) == dict.fromkeys(("one.png", "two.png"), "A")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert dict(mpl.rcParams) == before
