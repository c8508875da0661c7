"""Every benchmark runs, compares what it times, and says what it found; how fast that was is nobody's business here."""

import math
import sys
from collections import Counter
from importlib import import_module
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from smoke import benchmarks

from benchmarks import compilation, growth, history, timing
from benchmarks.__main__ import PEERS, Benchmark
from benchmarks.operations import count_operations
from benchmarks.timing import Disagreement, Ratio, Times, agree
from hybrid_jax.flights.log import COLUMNS


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
    for words in ("GFLOP/s", "C MuJoCo", "diffeqsolve", "best width", "weak scaling", "hidden units", "a CSV log"):
        assert words in run.stderr
    assert "Failed to import" not in run.stderr


@pytest.mark.slow
def test_the_environment_agrees_with_c_mujoco(report_of):
    report = report_of("environment")
    (row,) = report["rows"]
    assert row["difference"] < 1e-5
    assert set(row["steps_per_second"]) == {"ours", "ours_with_forces", "mujoco"}


@pytest.mark.slow
def test_three_integrators_predict_alike_and_have_the_same_gradient(report_of):
    report = report_of("rollout")
    *cases, forward = report["rows"]
    assert {row["work"] for row in cases} == {"prediction", "gradient"}
    for row in cases:
        for entry in ("seconds", "compile_seconds", "times_by_hand", "difference"):
            assert set(row[entry]) == {"hybrid_jax", "by_hand", "diffeqsolve"}
        assert max(row["difference"].values()) < 1e-5
    assert set(forward["windows_per_second"]) == {"rollout_batch", "rollout, vmapped"}
    assert {ratio["at_most"] for ratio in report["ratios"]} == {1.05, None}


@pytest.mark.slow
def test_our_gradient_step_is_the_plain_one(report_of):
    report = report_of("training_step")
    rows = {row["model"]: row for row in report["rows"]}
    assert len(rows) > 1  # the paper's model, and fields as a user writes them
    assert "hybrid" in rows
    for row in rows.values():
        assert row["difference"] < 1e-5
        assert min(row["windows_per_second"], row["gflops"], row["matrix_product_gflops"]) > 0
        calls = {"ours", "plain", *(["without kernels"] if row["bare_over_ours"] else [])}
        assert set(row["seconds"]) == set(row["compile_seconds"]) == calls


@pytest.mark.slow
def test_widths_of_chunks_train_alike(report_of):
    report = report_of("sweep")
    *cells, stopped, choice = report["rows"]
    assert {(row["width"], row["lanes"]) for row in cells} == {(width, lanes) for width in (1, 2) for lanes in (1, 2)}
    assert all(row["seconds_per_lane_epoch"] > 0 for row in cells)
    assert (stopped["active"], stopped["stopped"]) == (1, 1)
    assert choice["best_width"] in (1, 2)


@pytest.mark.slow
def test_weak_scaling_is_measured_in_processes_of_their_own(report_of):
    report = report_of("scaling")
    for row in report["rows"]:
        assert row["lanes"] == row["processes"] * row["devices"]
        assert min(row["seconds"].values()) >= 0
        assert row["seconds"]["epoch"] > 0
    # Every place with more than one device's lanes is held against the first.
    assert len(report["ratios"]) == sum(row["lanes"] > 1 for row in report["rows"])


@pytest.mark.slow
def test_growth_is_measured_along_every_axis_and_drawn(report_of, folder):
    report = report_of("growth")
    rows = {axis: [row for row in report["rows"] if row["axis"] == axis] for axis in growth.AXES}
    assert [len(points) for points in rows.values()] == [2, 2, 2, 2]
    for first, second in rows.values():
        assert second["bytes"] >= first["bytes"] > 0
        assert second["slope"] == pytest.approx(growth.slope(first, second))
    assert (folder / "all-growth.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_log_is_read_as_numpy_reads_it(report_of):
    both, once = report_of("ingest")["rows"]
    assert both["difference"] < 1e-9
    assert set(both["rows_per_second"]) == {"read_csv", "loadtxt"}
    assert once["peak_bytes"] > once["bytes"] == once["rows"] * len(COLUMNS) * 8


def test_a_slope_is_the_exponent():
    assert growth.slope({"number": 10, "seconds": 3.0}, {"number": 40, "seconds": 48.0}) == pytest.approx(2)


def test_no_moment_of_compilation_is_counted_twice():
    # Tracing within tracing, two threads at once, a pause.
    stages = [("outer", 5.0, 5.0), ("inner", 3.0, 2.0), ("beside", 6.0, 2.0), ("later", 10.0, 1.0)]
    assert compilation.waited(stages) == pytest.approx(7)
    assert compilation.waited([]) == 0


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


def test_operations_are_counted_in_loops_and_calls():
    def program(weight, x):
        return jax.lax.scan(lambda x, _: (jax.jit(jnp.tanh)(weight @ x), None), x, length=7)[0]

    # 7 products of (5, 5) by (5,), each of 25 multiply-adds, and 7 × 5 hyperbolic tangents.
    assert count_operations(program, np.ones((5, 5)), np.ones(5)) == Counter(matrix=7 * 50, elementwise=35)


def test_the_preset_that_is_reported_times_each_call_ten_times():
    for name in {*get_args(Benchmark), PEERS[0]} - {"compilation"}:
        assert import_module(f"benchmarks.{name}").PRESETS["full"].turns >= 10


def test_history_appends_and_refuses_what_is_none(tmp_path):
    file = tmp_path / "history.jsonl"
    for value in (2.0, 1.0):
        entries = history.append(file, {"a ratio": {"value": value, "at_most": 1.5, "at_least": None}})
    assert [entry["ratios"]["a ratio"]["value"] for entry in history.read(file)] == [2.0, 1.0]
    assert all(entry["commit"] and entry["hardware"]["cores"] for entry in entries)
    (drawn, *_) = history.figure(entries).axes[0].lines
    np.testing.assert_array_equal(drawn.get_ydata(), [2.0, 1.0])
    file.write_text(file.read_text() + "1\n")
    with pytest.raises(ValueError, match="line 3: expected an entry that --history wrote, got '1'"):
        history.read(file)
