"""Ablations: the configuration of each value, tables and figure, and the files of a run."""

import json
import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from reports import row
from rich.console import Console
from smoke import experiments

from experiments.ablation import PRESETS, Choice, conclusion, experiment, varied
from experiments.paper.conditions import Noise, measured
from experiments.paper.figures import ablation
from experiments.paper.lanes import TAGS
from experiments.paper.tables import ablation_tables
from experiments.reporting.results import Results
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.trajectories import Trajectories

TRUTH = {domain: {"Ix": 0.04, "Iy": 0.02, "k": 1e-5} for domain in ("parameter_shift", "external_force")}


def trial(choice, value, default, source_mse, error, ix=0.04):
    """Two seeds in both domains, source-only and fine-tuned at N = 100."""
    theta = {"Ix": ix, "Iy": 0.02, "k": 1e-5}
    rows = [
        row("hybrid", mode, n, seed, error * (1 + seed), domain, theta, val_mse=source_mse[seed])
        for domain in TRUTH
        for mode, n in (("source_only", 0), ("fine_tuned", 100))
        for seed in range(2)
    ]
    return Results(rows, TAGS).tagged(choice=choice, value=value, default=default)


ROWS = (
    trial("norm", "batch", True, [1e-3, 2e-3], 0.1)
    + trial("norm", "none", False, [1e-3, math.nan], 0.4, ix=0.05)
    + trial("solver", "heun", False, [1e-3, 2e-3], 0.2)
)


@pytest.mark.parametrize("choice", get_args(Choice))
def test_every_choice_has_its_default_once(choice):
    config = PRESETS["paper"]
    changed = list(varied(choice, config).values())
    assert changed.count(config) == 1
    assert len({str(other) for other in changed}) == len(changed) > 2


@pytest.mark.parametrize(("most", "sizes"), [(40, [40]), (1000, [300, 1000]), (5000, [300, 1000, 3000, 5000])])
def test_source_flights_are_at_most_those_asked_for(most, sizes):
    config = replace(PRESETS["smoke"], source_train=most)
    assert [other.source_train for other in varied("source", config).values()] == sizes


def test_initial_guess_in_a_range_ignores_perturbed_by():
    config = replace(PRESETS["paper"], perturbed_by=0.3)
    assert [other.perturbed_by for other in varied("start", config).values()] == [None, 0.2, 0.5, 1.0]


def test_contradictory_values_are_refused_before_any_flight(tmp_path):
    config = replace(PRESETS["smoke"], batch_size=1, norm="none", over=("weight", "norm"), out=tmp_path)
    with pytest.raises(ValueError, match="--batch-size must be at least 2 with --norm batch"):
        experiment(config, Console(quiet=True))
    assert not list(tmp_path.iterdir())


def test_tables_have_a_line_per_value_and_domain():
    norm, solver = ablation_tables(ROWS, TRUTH)
    assert [line[:2] for line in norm.lines] == [
        (target, value) for target in ("other inertia, 100", "side wind, 100") for value in ("batch (default)", "none")
    ]
    assert [line[1] for line in solver.lines] == ["heun", "heun"]
    assert norm.lines[0][4].startswith("0.15 ")  # of 0.1 and 0.2
    assert norm.lines[1][5] == "+25.0, +0.0, +0.0"
    assert "∞" in norm.lines[1][2]  # a pre-training that was not finite


def test_the_conclusion_says_what_helps_what_harms_and_what_does_nothing():
    """Paired by seed: of the same two seeds all errors here have one ratio, so that their intervals are points."""
    values = trial("norm", "none", False, [1e-3, 2e-3], 0.05) + trial("norm", "layer", False, [1e-3, 2e-3], 0.3)
    values += trial("norm", "batch", True, [1e-3, 2e-3], 0.1)
    values += trial("weight", "0", True, [1e-3, 2e-3], 0.1) + trial("weight", "1", False, [1e-3, 2e-3], 0.102)
    best, worst, idle = conclusion(values)
    assert best.startswith("Best of all is norm = none: 0.50 times (other inertia), 0.50 times (side wind)")
    assert worst.startswith("What harms most is norm = layer: 3.00 times")
    assert idle == "Changes nothing by more than 5%: weight."
    assert conclusion(ROWS.where(value="batch")) == []


def test_figure_has_a_panel_per_domain_and_a_line_per_value():
    drawn = ablation(ROWS.where(choice="norm"), "norm", {"external_force": 0.05})
    assert [axes.get_title() for axes in drawn.axes] == ["Other inertia", "Side wind"]
    assert [label.get_text() for label in drawn.axes[0].get_yticklabels()] == ["batch (default)", "none"]


def test_noise_has_its_size_and_spares_the_test_split():
    x = np.zeros((400, 10, 13), np.float32)
    x[..., 3] = 1
    clean = Trajectories(x[:, 0], np.zeros((400, 10, 4), np.float32), x, 0.01)
    noisy = measured(Dataset({"train": clean, "test": clean}, {}), 2.0, seed=0)
    np.testing.assert_array_equal(noisy.splits["test"].x, x)
    off = noisy.splits["train"].x - x
    # 4000 draws of a normal: its spread is known to 1.1 %.
    np.testing.assert_allclose(off[..., 0].std(), 2 * Noise().position, rtol=0.05)
    np.testing.assert_allclose(off[..., 12].std(), 2 * Noise().body_rates, rtol=0.05)
    np.testing.assert_allclose(np.linalg.norm(noisy.splits["train"].x0[:, 3:7], axis=1), 1, rtol=1e-6)


@pytest.mark.slow
def test_run_writes_report_page_and_figures(tmp_path):
    (run,) = experiments("ablation", "ablation", folder=tmp_path, options=("--over", "noise"))
    assert run.returncode == 0, run.stderr
    out = tmp_path / "out" / "ablation"
    rows = [row for row in json.loads((out / "report.json").read_text())["rows"] if row["choice"] == "noise"]
    assert {row["value"] for row in rows} == {f"{level} × typical" for level in ("0", "0.5", "1", "2")}
    assert [row["default"] for row in rows].count(True) == 4  # one seed, two modes, two domains
    assert (out / "noise.png").read_bytes().startswith(b"\x89PNG")
    assert "Noise" in (out / "report.md").read_text()
    by_level = {row["value"]: row["val_mse"] for row in rows if row["mode"] == "fine_tuned"}
    assert by_level["2 × typical"] > by_level["0 × typical"]  # validation is measured with the same noise
