"""Each program of an experiment in its smallest preset writes a row for every case, and its figures."""

import json

import pytest
from smoke import experiments

CASES = {
    "ablation": (("--over", "noise"), lambda rows, _: {row["value"] for row in rows if row["choice"] == "noise"} == {
        f"{level} × typical" for level in ("0", "0.5", "1", "2")
    }),
    "changes": ((), lambda rows, report: sum(row["taken"] for row in rows) == 1 and {"source", "theta", "network"} <= {
        row["candidate"] for row in rows
    } and [each["id"] for each in report["not_judged"]] == ["A5"]),  # with one draw there is no other flight
    # Beside them two truths, noise on two sets of states, three parameters.
    "coverage": ((), lambda rows, report: (len(rows), len(report["known_body"])) == (3, 12)),
    # Four flights, three parameters, two seeds.
    "excitation": ((), lambda rows, report: len(rows) == 24 and min(report["design"]["margins"].values()) >= 0),
    "reaction_diffusion": ((), lambda rows, _: {row["part"] for row in rows} == {"forecast", "shifted", "gray_scott"}),
    "worlds": ((), lambda rows, _: [(row["change"], row["flight"]) for row in rows] == [("nothing", "short")]),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_command_writes_its_rows_and_figures(name, tmp_path):
    options, complete = CASES[name]
    (run,) = experiments(name, name, folder=tmp_path, options=options)
    assert run.returncode == 0, run.stderr
    out = tmp_path / "out" / name
    report = json.loads((out / "report.json").read_text())
    assert complete(report["rows"], report)
    assert all((out / figure).read_bytes().startswith(b"\x89PNG") for figure in report["figures"])
    assert (out / "report.md").exists()
