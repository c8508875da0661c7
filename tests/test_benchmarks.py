"""Benchmarks compare what they time; rivals compute what we compute. How fast that is, nobody asks here."""

import sys
from importlib.util import find_spec

import numpy as np
import pytest
from smoke import benchmark

from benchmarks import timing
from benchmarks.timing import Disagreement, Ratio, Times, agree
from benchmarks.training_peers import BY_HAND, COMPILED, TORCHDIFFEQ


@pytest.mark.parametrize(
    ("options", "complaint"),
    [(["--output", "file/a.json"], "--output file: cannot be written"), (["--preset", "huge"], "--preset must be one")],
)
def test_bad_input_is_refused_in_one_line_before_measuring(options, complaint, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("kept")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["benchmark", *options])
    with pytest.raises(SystemExit, match="2"):
        timing.run("name", "About.", {"full": None, "smoke": None}, lambda preset: pytest.fail("was measured"))
    printed, complained = capsys.readouterr()
    (line,) = complained.splitlines()
    assert printed == ""
    assert line.startswith(f"name: {complaint}")
    assert (tmp_path / "file").read_text() == "kept"


def test_results_that_differ_are_not_timed_and_a_ratio_is_taken_within_turns():
    with pytest.raises(Disagreement, match="sums differ by"):
        agree("sums", [np.ones(3), np.ones(2)], [np.ones(3), np.array([1, 1.1])], 0.05)
    with pytest.raises(Disagreement, match="nan"):
        agree("sums", np.array([np.nan]), np.ones(1), 0.05)
    # The machine was ten times slower in the second turn: that is not a difference between the two.
    times = Times({"a": [1.0, 20.0, 3.0], "b": [2.0, 40.0, 4.0]})
    assert times.ratio("a", "b") == 0.5
    assert (times.median("a"), times.median("b")) == (3.0, 4.0)
    assert [Ratio("", 1.0, at_most=1.1).holds, Ratio("", 1.0, at_least=1.1).holds, Ratio("", 1.0).holds] == [1, 0, None]


@pytest.mark.slow
def test_the_gradient_step_of_every_rival_is_ours_on_one_core(tmp_path):
    _, report = benchmark("training_peers", tmp_path)
    assert report["cores_used"] == 1 or sys.platform != "linux"
    rows = {row["program"]: row for row in report["rows"] if "program" in row}
    assert rows["ours without kernels"]["difference"] < 1e-5
    pytest.importorskip("torch", reason="PyTorch is of the extra `peers`")
    for rival in (BY_HAND, COMPILED) + ((TORCHDIFFEQ,) if find_spec("torchdiffeq") else ()):
        assert rows[rival]["difference"] < 5e-5  # sums in another order, in float32
