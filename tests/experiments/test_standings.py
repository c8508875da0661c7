"""The comparison: its claim, its tables beside the paper's, its page."""

import io
import math
from dataclasses import replace

import pytest
from reports import TRUTH, make_report
from rich.console import Console

from experiments.paper.claims import claims
from experiments.paper.rows import DOMAINS, RIVALS, Row, from_csv, with_rho
from experiments.paper.standings import standings
from experiments.reporting.report import load_report, print_report, write_report

# As in Table 2, and other rivals behind: means for the hybrid, the best of the seeds for the rest.
ERRORS = {
    ("hybrid", "fine_tuned"): (3.26e-3, 2.64e-3),
    ("expert_augmentation", "source_only"): (3.68e-3, 4.02e-3),
    ("physics_only", "fine_tuned"): (3.76e-3, 4.53e-3),
    **{(rival, "fine_tuned"): (5e-3, 5e-3) for rival in RIVALS if rival != "expert_augmentation"},
    ("hybrid", "source_only"): (0.02, 0.03),
    ("physics_only", "source_only"): (0.01, 0.01),
}
TRUTHS = {"parameter_shift": TRUTH, "external_force": TRUTH | {"Ix": 0.029, "Iy": 0.029}}


def compared_rows(seeds=3):
    """Three seeds 1 % apart: around the mean for the fine-tuned hybrid, from the best on for every other method."""
    return with_rho(
        Row(domain, model, mode, 100 * (mode == "fine_tuned"), seed, error * (1 + 0.01 * (seed - centre)), None, 1e-3,
            9, "ok", TRUTHS[domain], dict.fromkeys(TRUTH, (0, 1)))
        for (model, mode), errors in ERRORS.items()
        for domain, error in zip(DOMAINS, errors, strict=True)
        for centre in [(seeds - 1) / 2 if (model, mode) == ("hybrid", "fine_tuned") else 0]
        for seed in range(seeds)
    )  # fmt: skip


def spoilt(rows, model, error, domain=None):
    """The rows with the test error of one model's adapted rows computed anew."""
    return [
        replace(row, test_mse=error(row), rho=None)
        if row.model == model and domain in (None, row.domain) and (model in RIVALS or row.n_train)
        else row
        for row in rows
    ]


def verdict(rows):
    (claim,) = claims(rows, "comparison", None)
    assert claim.id == "C9"
    return claim


def test_c9_holds_for_the_papers_own_numbers():
    claim = verdict(compared_rows())
    assert claim.holds is True
    for number in ("0.00326", "0.00368", "0.00376", "0.00264", "0.00402", "0.00453"):
        assert number in claim.measured
    assert "parameter shift: " in claim.measured
    assert "external force: " in claim.measured


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize(
    ("model", "factor"),
    [("hybrid", 2), ("expert_augmentation", 1.5), ("expert_augmentation", 0.3), ("physics_only", 0.8)],
)
def test_c9_needs_the_whole_order_in_both_domains(domain, model, factor):
    assert verdict(spoilt(compared_rows(), model, lambda row: row.error * factor, domain)).holds is False


def test_c9_takes_the_hybrids_mean_and_the_others_best():
    """One bad seed ruins the hybrid, but not a rival."""
    for model, holds in (("hybrid", False), ("expert_augmentation", True), ("physics_only", True)):
        rows = spoilt(compared_rows(), model, lambda row: math.nan if row.seed == 2 else row.error)
        assert verdict(rows).holds is holds


@pytest.mark.parametrize(
    "lacks",
    [
        lambda row: row.domain == "external_force",
        lambda row: row.model == "expert_augmentation",
        lambda row: (row.domain, row.model, row.n_train) == ("external_force", "physics_only", 100),
        lambda row: True,
    ],
)
def test_c9_is_not_judged_where_a_domain_or_a_method_is_missing(lacks):
    claim = verdict([row for row in compared_rows() if not lacks(row)])
    assert claim.holds is None
    assert "there are no rows of" in claim.measured


def test_the_standings_repeat_the_papers_ratios_when_the_rows_are_its_own():
    for table, physics in zip(standings(compared_rows()), (3.76e-3, 4.53e-3), strict=True):
        column = {line[0]: dict(zip(table.header, line, strict=True)) for line in table.lines}
        assert len(column) == len(table.lines) == len(ERRORS)
        for name in ("hybrid", "Expert Augmentation", "physics-only"):
            assert column[name]["ratio to physics-only's smallest"] == column[name]["paper's ratio"] != "–"
        assert column["physics-only"]["smallest"] == f"{physics:.2e}"
        assert column["θ_p only"]["paper"] == "–"
        assert column["hybrid, source-only"]["N"] == column["Expert Augmentation"]["N"] == "–"


def test_the_standings_quote_table_2():
    first, second = standings(compared_rows())
    quoted = [[line[5] for line in table.lines if line[5] != "–"] for table in (first, second)]
    assert quoted[0] == ["3.26e-03 ± 2.66e-05", "3.68e-03 (smallest)", "3.76e-03 (smallest)"]
    assert quoted[1] == ["2.64e-03 ± 1.56e-04", "4.02e-03 (smallest)", "4.53e-03 (smallest)"]
    assert [line[6] for line in first.lines[:3]] == ["0.867 (mean)", "0.979 (smallest)", "1 (smallest)"]


def test_a_method_with_an_infinite_error_stands_last_with_what_it_has():
    rows = spoilt(compared_rows(), "theta_p_only", lambda row: math.inf if row.seed == 1 else row.error)
    rows = spoilt(rows, "physics_only", lambda row: math.nan, "external_force")
    shift, force = standings(rows)
    assert shift.lines[-1][:5] == (
        "θ_p only",
        "100",
        "5.00e-03",
        "∞ (1 of 3 seeds not finite, median 5.10e-03)",
        "1.33 (smallest)",
    )
    assert force.lines[-1][:5] == ("physics-only", "100", "∞", "∞ (3 of 3 seeds not finite, median ∞)", "–")
    assert {line[4] for line in force.lines} == {"–"}


def test_the_page_of_a_comparison_has_its_own_tables_and_reads_back(tmp_path):
    report = make_report(compared_rows(), "comparison", TRUTHS, figures={"standings.png": "Every seed"}, notes=["A."])
    write_report(tmp_path, report)
    assert load_report(tmp_path) == report
    assert from_csv((tmp_path / "rows.csv").read_text()) == report.rows
    page = (tmp_path / "report.md").read_text()
    headings = [line for line in page.splitlines() if line.startswith("## ")]
    assert headings[0].startswith("## Test error L^T_MSE, parameter shift (experiment 1 of the paper; 3 seeds")
    assert headings[1].startswith("## Test error L^T_MSE, external force (experiment 2 of the paper; 3 seeds")
    assert headings[2] == "## Claims of the paper"
    assert [" θ_p, parameter shift" in headings[3], " θ_p, external force" in headings[4]] == [True, True]
    assert page.count("| C9 |") == 1
    assert "N, target trajectories" not in page
    assert all(page.count(f"- **{name}**") == 1 for name in ("Expert Augmentation", "θ_p only", "last layer (ridge)"))
    assert "95 % ± 0.5" in page
    text = io.StringIO()
    print_report(Console(file=text, width=200), report)
    assert "✓ holds" in text.getvalue()
