"""From the rows of a committed report the code makes the verdicts that it has; and its tables and sentences."""

import json

import pytest

from experiments import ablation, coverage
from experiments.closed_loop import claims as flown
from experiments.closed_loop import results as closed_loop
from experiments.excitation import results as excitation
from experiments.online import results as online
from experiments.paper import regret
from experiments.paper.config import PRESETS
from experiments.paper.outcome import FLOOR, paper_report
from experiments.paper.tables import ablation_tables
from experiments.reaction_diffusion import report as reaction_diffusion
from experiments.redraw import REFERENCE
from experiments.reporting.claims import evaluate
from experiments.reporting.results import Results
from experiments.worlds import verdicts as worlds

TIMED = {"R7", "R8", "O5", "O6"}  # decided by a clock, and not by rows


def paper(rows, record):
    truth, floor = record["truth_theta"], record.get(FLOOR, 0.0)
    found = paper_report(record["experiment"], PRESETS["paper"], {}, rows, truth, {}, (), floor)
    return found.claims, found.tables, found.conclusion


def of_flights(rows, _):
    verdicts = evaluate(flown.claims(100), flown.FlightEvidence(rows, flown.Speed(*[1.0] * 6)))
    return verdicts, [*closed_loop.tables(rows), *closed_loop.gap_tables(rows)], closed_loop.conclusion(rows, 100)


def of_filters(rows, record):
    evidence = online.GoalEvidence(rows, *[1.0] * 4)
    return evaluate(online.claims(record["config"]["changes"]), evidence), online.tables(rows), online.conclusion(rows)


def of_designs(rows, _):
    verdicts = evaluate(excitation.CLAIMS[:1], excitation.DesignEvidence(rows, {}))  # the other needs the flown states
    return verdicts, excitation.tables(rows), excitation.conclusion(rows)


def of_equations(rows, _):
    verdicts = evaluate(reaction_diffusion.claims(rows), rows)
    return verdicts, reaction_diffusion.tables(rows), reaction_diffusion.conclusion(rows)


def of_rows(claims, tables, conclusion):
    return lambda rows, _: (evaluate(claims, rows), [table(rows) for table in tables], conclusion(rows))


MADE = {
    "ablation": lambda rows, _: ([], ablation_tables(rows, ablation.TRUTH), ablation.conclusion(rows)),
    "changes": of_rows(regret.CLAIMS, (regret.regret_table, regret.error_table), regret.conclusion),
    "closed_loop": of_flights,
    "comparison": paper,
    "coverage": of_rows(coverage.CLAIMS, (coverage.pooled_table,), coverage.conclusion),
    "excitation": of_designs,
    "external_force": paper,
    "online": of_filters,
    "param_shift": paper,
    "reaction_diffusion": of_equations,
    "worlds": of_rows(worlds.CLAIMS, (worlds.ratio_table, worlds.method_table), worlds.conclusion),
}
# Those of real_flight are of an earlier program.
REPORTS = [path.parent for path in sorted(REFERENCE.rglob("report.json")) if "real_flight" not in path.parts]


@pytest.mark.parametrize(
    "folder",
    [pytest.param(path, marks=[pytest.mark.slow] * (path.name == "closed_loop")) for path in REPORTS],
    ids=lambda folder: str(folder.relative_to(REFERENCE)),
)
def test_its_verdicts_are_those_of_its_rows(folder):
    record = json.loads((folder / "report.json").read_text())
    rows = Results(record["rows"], record.get("tags") or ())
    verdicts, tables, sentences = MADE[record["experiment"]](rows, record)
    found = {each.id: each.holds for each in verdicts if not each.lacks_data}
    known = {each["id"]: each["holds"] for each in record["claims"] if each["id"] in found}
    assert {id: found[id] for id in found.keys() - TIMED} == {id: known[id] for id in known.keys() - TIMED}
    assert all(len(line) == len(table.header) for table in tables for line in table.lines)
    assert tables
    assert sentences
