"""Each claim of the paper holds for rows like the paper's, and fails or is inconclusive for others."""

import pytest
from reports import TRUTH, changed, make_rows, verdicts

from experiments.paper.claims import claims
from experiments.paper.lanes import DOMAINS
from experiments.reporting.claims import Claim, Inconclusive, Verdict, evaluate, to_json


def test_claims_hold_for_rows_like_the_papers():
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
def test_claim_fails(fails, change):
    *cell, fields = change
    assert verdicts(changed(make_rows(), *cell, **fields))[fails] is False


def test_divergence_counts_as_failure_under_external_force_only():
    both = make_rows() + make_rows(domain="external_force")
    rows = changed(both, "no_physics", "fine_tuned", 100, factor=0.7, status="diverged")
    assert verdicts(rows)["C3"] is False
    assert verdicts(rows, "external_force")["C3"] is True
    assert "C10" not in verdicts(rows, "external_force")


@pytest.mark.parametrize(("experiment", "domain"), [("param_shift", DOMAINS[0]), ("external_force", DOMAINS[1])])
def test_claims_ignore_rows_of_other_domains(experiment, domain):
    own, other = make_rows(domain=domain), make_rows(domain=next(name for name in DOMAINS if name != domain))
    spoilt = changed(other, "hybrid", "fine_tuned", 100, factor=1e6)
    assert claims(own + spoilt, experiment, TRUTH) == claims(own, experiment, TRUTH)
    assert "C9" not in verdicts(own, experiment)


def test_claims_are_inconclusive_without_the_rows_they_need():
    one_seed = verdicts(make_rows(seeds=1))
    assert (one_seed["C1"], one_seed["C4"], one_seed["C7"]) == (True, None, None)
    one_size = verdicts(make_rows(sizes=(100,)))
    assert (one_size["C3"], one_size["C5"], one_size["C7"], one_size["C8"]) == (True, None, None, None)
    assert verdicts(make_rows(), truth=None)["C10"] is None
    assert set(verdicts(make_rows().where(model=())).values()) == {None}


def test_json_separates_what_is_inconclusive():
    def undecided(_):
        raise Inconclusive("no rows")

    found = evaluate([Claim("C2", "less", lambda x: (x < 1, f"{x}")), Claim("C10", "?", undecided)], 0.5)
    assert found == [Verdict("C2", "less", True, "0.5"), Verdict("C10", "?", None, "no rows")]
    assert to_json(found)["claims"] == [{"id": "C2", "text": "less", "holds": True, "measured": "0.5"}]
    assert to_json(found)["not_judged"] == [{"id": "C10", "text": "?", "why": "no rows"}]
