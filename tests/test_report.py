"""Rows, claims and what is written of them."""

import io
import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from hybrid_jax.claims import EXPERIMENTS, claims
from hybrid_jax.environment import PACKAGES, environment
from hybrid_jax.report import FLOOR, Report, load_report, print_report, write_report
from hybrid_jax.report_tables import parameters
from hybrid_jax.rows import (
    DOMAIN_OF,
    DOMAINS,
    MODELS,
    MODES,
    RIVALS,
    STATUSES,
    THETA,
    Row,
    from_csv,
    row_from,
    to_csv,
    with_rho,
)
from hybrid_jax.summary import grouped, spread, summarise

TRUTH = {"Ix": 0.04, "Iy": 0.02, "k": 8.5e-6}
SIZES = (100, 500, 1000)
# Mean test errors as in the paper: every claim holds.
ERRORS = {
    ("hybrid", "source_only"): {0: 2.6},
    ("no_physics", "source_only"): {0: 2.3},
    ("hybrid", "fine_tuned"): {100: 0.022, 500: 0.018, 1000: 0.016},
    ("hybrid", "target_only"): {100: 0.14, 500: 0.019, 1000: 0.0161},
    ("no_physics", "fine_tuned"): {100: 2.9, 500: 1.6, 1000: 1.2},
    ("no_physics", "target_only"): {100: 9.0, 500: 2.0, 1000: 1.2},
}


def make_rows(seeds=3, sizes=SIZES, errors=ERRORS, theta=TRUTH, domain="parameter_shift"):
    """The seeds' errors lie 2 % apart around the mean."""
    return with_rho(
        Row(
            domain,
            model,
            mode,
            n,
            seed,
            mean * (1 + 0.02 * (seed - (seeds - 1) / 2)),
            None,
            mean / 100,
            150,
            "ok",
            known,
        )
        for (model, mode), means in errors.items()
        for n, mean in means.items()
        for seed in range(seeds)
        for known in [None if model == "no_physics" else theta]
        if n in (0, *sizes)
    )


def changed(rows, model, mode, n_train, **fields):
    """The rows with a factor on `test_mse`, or other fields, changed in one cell, and ρ to match."""
    factor = fields.pop("factor", 1.0)
    cell = (model, mode, n_train)
    return with_rho(
        replace(r, **{"test_mse": r.error * factor} | fields) if (r.model, r.mode, r.n_train) == cell else r
        for r in rows
    )


def verdicts(rows, experiment="param_shift", truth=TRUTH):
    return {claim.id: claim.holds for claim in claims(rows, experiment, truth)}


def make_report(rows, experiment="param_shift", truth=TRUTH, **fields):
    judged = claims(rows, experiment, truth)
    surroundings = environment({"training": 12.5})
    return Report(experiment, {"preset": "quick", "sizes": [100]}, surroundings, rows, judged, truth, **fields)


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


def test_all_claims_hold_for_rows_of_the_papers_shape():
    assert verdicts(make_rows()) == dict.fromkeys(["C1", "C2", "C3", "C4", "C5", "C6", "C7", "C8", "C10"], True)


@pytest.mark.parametrize(
    ("fails", "change"),
    [
        ("C1", ("no_physics", "fine_tuned", 500, {"factor": 0.01})),
        ("C2", ("no_physics", "fine_tuned", 1000, {"factor": 0.001})),
        ("C3", ("no_physics", "fine_tuned", 100, {"factor": 0.7})),
        ("C3", ("hybrid", "fine_tuned", 100, {"factor": 200})),
        ("C4", ("no_physics", "fine_tuned", 500, {"test_mse": 1.6})),
        ("C5", ("hybrid", "fine_tuned", 500, {"factor": 1.3})),
        ("C5", ("no_physics", "fine_tuned", 1000, {"factor": 1.5})),
        ("C6", ("hybrid", "fine_tuned", 1000, {"factor": 200})),
        ("C7", ("hybrid", "target_only", 100, {"factor": 0.2})),
        ("C7", ("hybrid", "target_only", 1000, {"factor": 1.6})),
        ("C8", ("hybrid", "fine_tuned", 100, {"factor": 1.2})),
        ("C10", ("hybrid", "fine_tuned", 100, {"theta": TRUTH | {"Ix": 0.0423}})),
        ("C10", ("hybrid", "fine_tuned", 500, {"theta": TRUTH | {"Iy": None}})),
    ],
)
def test_a_claim_fails_when_the_rows_say_so(fails, change):
    *cell, fields = change
    assert verdicts(changed(make_rows(), *cell, **fields))[fails] is False


def test_diverging_counts_as_failing_under_the_external_force_only():
    both = [row for domain in DOMAINS for row in make_rows(domain=domain)]
    rows = changed(both, "no_physics", "fine_tuned", 100, factor=0.7, status="diverged")
    assert verdicts(rows)["C3"] is False
    assert verdicts(rows, "external_force")["C3"] is True
    assert "C10" not in verdicts(rows, "external_force")


@pytest.mark.parametrize("experiment", DOMAIN_OF)
def test_a_claim_about_one_domain_does_not_see_the_others_rows(experiment):
    own, other = (
        make_rows(domain=domain) for domain in sorted(DOMAINS, key=lambda name: name != DOMAIN_OF[experiment])
    )
    spoilt = changed(other, "hybrid", "fine_tuned", 100, factor=1e6)
    assert claims([*own, *spoilt], experiment, TRUTH) == claims(own, experiment, TRUTH)
    assert "C9" not in verdicts(own, experiment)


def test_what_the_rows_cannot_judge_is_said_and_not_judged():
    one_seed = verdicts(make_rows(seeds=1))
    assert (one_seed["C1"], one_seed["C4"], one_seed["C7"]) == (True, None, None)
    one_size = verdicts(make_rows(sizes=(100,)))
    assert (one_size["C3"], one_size["C5"], one_size["C7"], one_size["C8"]) == (True, None, None, None)
    assert verdicts(make_rows(), truth=None)["C10"] is None
    assert set(verdicts([]).values()) == {None}


def test_claims_refuse_an_experiment_they_are_not_about_and_rows_that_stand_twice():
    with pytest.raises(ValueError, match="param_shift, external_force"):
        claims([], "param_shfit", TRUTH)
    with pytest.raises(ValueError, match="stands 2 times"):
        claims([*make_rows(), make_rows()[0]], "param_shift", TRUTH)


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


NUMBERS = st.none() | st.floats(min_value=0) | st.sampled_from([math.nan, math.inf, np.float32(0.1)])
THETAS = st.none() | st.fixed_dictionaries({name: st.none() | st.floats() for name in THETA})
PAIRS = st.lists(st.floats(allow_nan=False), min_size=2, max_size=2).map(sorted) | st.sampled_from(
    [None, [0.0, math.nan]]
)
INTERVALS = st.none() | st.fixed_dictionaries(dict.fromkeys(THETA, PAIRS))


@st.composite
def odd_rows(draw):
    mode = draw(st.sampled_from(MODES))
    theta = draw(THETAS)
    return Row(
        domain=draw(st.sampled_from(DOMAINS)),
        model=draw(st.sampled_from(MODELS)),
        mode=mode,
        n_train=0 if mode == "source_only" else draw(st.sampled_from([1, 100, 500, 1000])),
        seed=draw(st.integers(0, 2)),
        test_mse=draw(NUMBERS),
        rho=draw(st.none() | st.floats()),
        val_mse=draw(NUMBERS),
        epochs=draw(st.integers(0, 10**6)),
        status=draw(st.sampled_from(STATUSES)),
        theta=theta,
        theta_interval=draw(INTERVALS) if theta else None,
    )


def identity(row):
    """No two rows of a report share it."""
    return row.domain, row.model, row.mode, row.n_train, row.seed


ODD_ROWS = st.lists(odd_rows(), max_size=12, unique_by=identity)


@settings(max_examples=40, deadline=None)
@given(ODD_ROWS, st.sampled_from(EXPERIMENTS))
def test_any_rows_make_a_report_that_reads_back(tmp_path_factory, rows, experiment):
    out = tmp_path_factory.mktemp("report")
    write_report(out, make_report(rows, experiment))
    assert load_report(out).rows == rows == from_csv((out / "rows.csv").read_text())


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
