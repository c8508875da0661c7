"""Every benchmark runs, compares what it times, and says what it found; how fast that was is nobody's business here."""

import math
import sys
from importlib import import_module
from typing import get_args

import jax
import numpy as np
import pytest
from smoke import benchmarks

from benchmarks import timing
from benchmarks.__main__ import PEERS, Benchmark
from benchmarks.timing import Disagreement, Ratio, Times, agree


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("benchmarks")


@pytest.fixture(scope="module")
def everything(folder):
    """What all benchmarks in their smallest preset said, and the report of each."""
    return benchmarks(folder)


@pytest.fixture
def report_of(everything):
    """The report of a benchmark by its name, once it is known to be sound."""

    def sound(name):
        report = everything[1][name]
        assert report["preset"] == "smoke"
        assert report["environment"]["versions"]["jax"] == jax.__version__
        assert report["environment"]["hardware"]["cores"] >= report["cores_used"] >= 1
        assert all(math.isfinite(ratio["value"]) for ratio in report["ratios"])
        return report

    return sound


@pytest.mark.slow
def test_one_command_gathers_the_ratios_of_all(everything):
    run, reports = everything
    assert set(reports) >= {*get_args(Benchmark)}
    printed = " ".join(run.stdout.split())
    for name, report in reports.items():
        for ratio in report["ratios"]:
            assert f"{name}: {ratio['what'].split()[0]}" in printed
    # The benchmarks' own tables are beside the result, not in it.
    for words in ("best width", "on a grid"):
        assert words in run.stderr
    assert "Failed to import" not in run.stderr


@pytest.mark.slow
def test_widths_of_chunks_train_alike(report_of):
    report = report_of("sweep")
    *cells, choice = report["rows"]
    assert {(row["width"], row["lanes"]) for row in cells} == {(width, lanes) for width in (1, 2) for lanes in (1, 2)}
    assert all(row["seconds_per_lane_epoch"] > 0 for row in cells)
    assert choice["best_width"] in (1, 2)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--out", "file/report.json"], "--out file: cannot be written"),
        (["--out", "folder"], "--out folder: is a folder"),
        (["--preset", "huge"], "--preset must be one of full, smoke, got 'huge'"),
    ],
)
def test_bad_input_is_refused_in_one_line_before_anything_is_measured(
    options, complaint, tmp_path, monkeypatch, capsys
):
    (tmp_path / "file").write_text("kept")
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["benchmark", *options])
    with pytest.raises(SystemExit, match="2"):
        timing.run("name", "About.", {"full": None, "smoke": None}, lambda preset: pytest.fail("was measured"))
    printed, complained = capsys.readouterr()
    (line,) = complained.splitlines()
    assert printed == ""
    assert line.startswith(f"name: {complaint}")
    assert (tmp_path / "file").read_text() == "kept"


def test_results_that_differ_are_not_timed():
    with pytest.raises(Disagreement, match="sums differ by"):
        agree("sums", [np.ones(3), np.ones(2)], [np.ones(3), np.array([1, 1.1])], 0.05)
    with pytest.raises(Disagreement, match="nan"):
        agree("sums", np.array([np.nan]), np.ones(1), 0.05)


def test_a_ratio_is_taken_within_turns():
    # The machine was ten times slower in the second turn: that is not a difference between the two.
    times = Times({"a": [1.0, 20.0, 3.0], "b": [2.0, 40.0, 4.0]})
    assert times.ratio("a", "b") == 0.5
    assert times.medians() == {"a": 3.0, "b": 4.0}
    assert [Ratio("", 1.0, at_most=1.1).holds, Ratio("", 1.0, at_least=1.1).holds, Ratio("", 1.0).holds] == [1, 0, None]


def test_the_preset_that_is_reported_times_each_call_ten_times():
    for name in {*get_args(Benchmark), PEERS}:
        assert import_module(f"benchmarks.{name}").PRESETS["full"].turns >= 10
