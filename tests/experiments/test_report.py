"""What is written of rows and claims, and reads back."""

import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reports import ODD_ROWS, TRUTH, changed, make_report, make_rows
from rich.console import Console

from experiments.paper.claims import EXPERIMENTS
from experiments.paper.rows import DOMAINS, THETA, from_csv
from experiments.reporting.report import FLOOR, load_report, print_report, write_report
from experiments.reporting.report_tables import lane_notes, parameters
from experiments.runner.environment import PACKAGES


def test_report_json_keeps_the_contract(tmp_path):
    rows = changed(make_rows(seeds=1), "no_physics", "fine_tuned", 500, test_mse=math.nan, status="diverged")
    write_report(tmp_path, make_report(rows, extra={FLOOR: 1e-3, "odd": np.array([1.0, math.inf])}))
    record = json.loads((tmp_path / "report.json").read_text(), parse_constant=pytest.fail)
    assert {"experiment", "config", "environment", "rows", "claims", "not_judged"} <= set(record)
    assert set(record["environment"]) >= {"versions", "hardware", "seconds"}
    assert set(PACKAGES) < set(record["environment"]["versions"])
    fields = "domain model mode n_train seed test_mse rho val_mse epochs status theta theta_interval"
    assert all(list(row) == fields.split() for row in record["rows"])
    assert any(row["test_mse"] is None and row["rho"] is None for row in record["rows"])
    assert all(set(claim) == {"id", "text", "holds", "measured"} for claim in record["claims"])
    assert all(type(claim["holds"]) is bool for claim in record["claims"])
    assert {claim["id"] for claim in record["not_judged"]} == {"C4", "C7"}
    assert all(claim["why"] for claim in record["not_judged"])
    assert record["odd"] == [1.0, None]


def test_loading_gives_back_what_was_written(tmp_path):
    report = make_report(make_rows(), figures={"scores.png": "Scores"}, notes=["A note."], extra={"more": [1, 2]})
    write_report(tmp_path, report)
    assert load_report(tmp_path) == report == load_report(tmp_path / "report.json")
    assert from_csv((tmp_path / "rows.csv").read_text()) == report.rows


def test_a_report_of_before_rows_had_domains_and_intervals_reads_as_of_its_experiments_domain(tmp_path):
    report = make_report(make_rows())
    write_report(tmp_path, report)
    record = json.loads((tmp_path / "report.json").read_text())
    new = ("domain", "theta_interval")
    record["rows"] = [{name: row[name] for name in row if name not in new} for row in record["rows"]]
    (tmp_path / "old.json").write_text(json.dumps(record))
    assert load_report(tmp_path / "old.json").rows == report.rows
    (tmp_path / "other.json").write_text(json.dumps(record | {"experiment": "mine"}))
    with pytest.raises(ValueError, match=r"rows\[0\].*domain"):
        load_report(tmp_path / "other.json")


def test_parameters_stand_with_the_spread_over_seeds_and_the_width_of_their_intervals():
    offsets = (-4e-4, 0.0, 4e-4)
    thetas = [TRUTH | {"Ix": 0.0398 + offset} for offset in offsets]
    rows = [
        replace(row, theta=thetas[row.seed], theta_interval={"Ix": [0.039, 0.0402], "Iy": None, "k": None})
        for row in make_rows()
        if row.model == "hybrid" and row.n_train == 100 and row.mode == "fine_tuned"
    ]
    some = [replace(rows[0], theta_interval=dict.fromkeys(THETA)), *rows[1:]]
    for some_rows, cell in (
        (rows, "0.0398 ± 0.0004, 95 % ± 0.0006 (3 of 3 true)"),
        (some, "0.0398 ± 0.0004, 95 % ± 0.0006 in 2 of 3 seeds (2 of 3 true)"),
    ):
        (table,) = parameters(some_rows, TRUTH)
        assert table.lines[0][3] == cell
        assert table.lines[0][4] == "0.02 ± 0, 95 % interval not finite"
        (untold,) = parameters(some_rows, None)
        assert untold.lines[0][3] == cell.partition(" (")[0]
        assert table.lines[-1][:1] + table.lines[-1][3:] == ("truth", "0.04", "0.02", "8.5e-06")


def test_parameters_of_two_domains_stand_beside_the_truth_of_each():
    both = [row for domain in DOMAINS for row in make_rows(domain=domain)]
    truth = {"parameter_shift": TRUTH, "external_force": TRUTH | {"Ix": 0.029}}
    shift, force = parameters(both, truth)
    assert (shift.lines[-1][3], force.lines[-1][3]) == ("0.04", "0.029")
    assert "parameter shift" in shift.title
    assert "external force" in force.title


def test_the_page_says_everything_once(tmp_path):
    rows = changed(make_rows(), "no_physics", "fine_tuned", 500, test_mse=math.inf, status="diverged")
    report = make_report(rows, figures={"a/scores.png": "Scores | all"}, notes=["Odd|note."], extra={FLOOR: 1.234e-3})
    write_report(tmp_path, report)
    page = (tmp_path / "report.md").read_text()
    for claim in report.claims:
        assert page.count(f"| {claim.id} | {claim.text} |") == 1
    assert "](a/scores.png)" in page
    assert "Odd\\|note." in page
    assert "1.23e-03" in page
    assert f"3 of {len(rows)} runs have a test error that is not finite" in page
    assert "∞ (3 of 3 seeds not finite" in page
    tables = [line for line in page.splitlines() if line.startswith("|")]
    assert all(line.endswith("|") for line in tables)


def test_the_notes_count_the_diverged_and_name_their_epochs():
    rows = changed(make_rows(), "no_physics", "fine_tuned", 500, status="diverged", epochs=7)
    notes = lane_notes(changed(rows, "hybrid", "fine_tuned", 100, status="diverged", epochs=1))
    assert notes[1].startswith(f"6 of {len(rows)} runs met a non-finite loss, in epoch 1, 7, and count with their best")
    assert lane_notes(make_rows())[1].startswith(f"0 of {len(rows)} runs met a non-finite loss and count")


def test_the_terminal_shows_each_verdict_and_unit():
    text = io.StringIO()
    rows = changed(make_rows(), "hybrid", "fine_tuned", 100, factor=1.2)
    print_report(Console(file=text, width=200), make_report(rows))
    printed = text.getvalue()
    assert printed.count("✓ holds") + printed.count("✗ fails") == 9
    assert "✗ fails" in printed
    assert "[kg m²]" in printed


def test_nothing_is_written_when_a_value_cannot_be(tmp_path):
    for extra in ({"rows": 1}, {"thing": object()}, {"text": "\ud800"}):
        with pytest.raises(ValueError):  # noqa: PT011  three refusals, three messages
            write_report(tmp_path / "new", make_report(make_rows(), extra=extra))
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "[" * 200_000,
        lambda text: "[]",
        lambda text: text.replace('"rows"', '"raws"'),
        lambda text: text.replace('"epochs": 150', '"epochs": -1', 1),
        lambda text: text.replace('"epochs": 150', '"epochs": true', 1),
        lambda text: text.replace('"mode": "fine_tuned"', '"mode": "tuned"', 1),
        lambda text: text.replace('"mode": "source_only"', '"mode": "fine_tuned"', 1),
        lambda text: text.replace('"holds": true', '"holds": "yes"', 1),
        lambda text: text.replace('"k": 8.5e-06', '"k": NaN', 1),
        lambda text: text.replace('"truth_theta": {', '"truth_theta": {"external_force": null,'),
        lambda text: text.replace('"domain": "parameter_shift"', '"domain": "source"', 1),
        lambda text: text.replace('"theta_interval": null', '"theta_interval": [1, 2]', 1),
        lambda text: text.replace('"seed": 0', '"seed": 1', 1),
        lambda text: text.replace('"val_mse": 0.', '"val_mse": -0.', 1),
    ],
)
def test_a_bad_file_ends_in_one_line_that_names_it(tmp_path, spoil):
    write_report(tmp_path, make_report(make_rows()))
    path = tmp_path / "report.json"
    path.write_text(spoil(path.read_text()))
    with pytest.raises(ValueError, match=r"report\.json") as caught:
        load_report(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"none\.json: cannot be read"):
        load_report(tmp_path / "none.json")


@settings(max_examples=40, deadline=None)
@given(ODD_ROWS, st.sampled_from(EXPERIMENTS))
def test_any_rows_make_a_report_that_reads_back(tmp_path_factory, rows, experiment):
    out = tmp_path_factory.mktemp("report")
    write_report(out, make_report(rows, experiment))
    assert load_report(out).rows == rows == from_csv((out / "rows.csv").read_text())
