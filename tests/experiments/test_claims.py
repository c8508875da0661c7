"""Claims hold where the rows say so, and only there."""

import pytest
from reports import TRUTH, changed, make_rows, verdicts

from experiments.paper.claims import claims
from experiments.paper.rows import DOMAIN_OF, DOMAINS


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
