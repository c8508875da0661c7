"""Both experiments from their command lines, in the smallest preset: their files, and the input they refuse."""

import json
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from scipy.integrate import cumulative_trapezoid
from smoke import ROOT, experiments, refused, smallest, unbegun

import hybrid_jax
from experiments.external_force import sine_floor
from experiments.paper.config import SMOKE
from experiments.paper.lanes import physics_in
from experiments.paper.study import placeholder, study
from hybrid_jax.sim.domain import PARAMETER_SHIFT
from hybrid_jax.sim.flight import SplitSpec
from hybrid_jax.vehicle import IRIS

EXPERIMENTS = ("param_shift", "external_force")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("experiments")


@pytest.fixture(scope="module")
def finished(folder):
    """Each experiment run once; the second finds the first one's pre-training in the cache."""
    runs = dict(zip(EXPERIMENTS, experiments("shifts", *EXPERIMENTS, folder=folder), strict=True))
    assert {name: run.returncode for name, run in runs.items()} == dict.fromkeys(EXPERIMENTS, 0), runs
    return runs


@pytest.mark.slow
def test_every_row_has_a_model_that_loads_and_predicts(folder, finished):
    at_rest = placeholder(SplitSpec(2, 5))
    out = folder / "out" / "param_shift"
    rows = json.loads((out / "report.json").read_text())["rows"]
    assert len(list((out / "models").iterdir())) == len(rows)
    for row in rows:
        model = hybrid_jax.load(out / "models" / f"{row['model']}-{row['mode']}-{row['n_train']}-seed{row['seed']}.npz")
        assert model.about["test_mse"] == row["test_mse"]
        if row["theta"] is not None:
            assert {key: float(value) for key, value in physics_in(model.field).theta().items()} == row["theta"]
    predicted = model.predict(at_rest.x0, at_rest.u + IRIS.hover_speed, model.about["dt"])
    assert predicted.shape == (2, 5, 13)
    assert np.isfinite(predicted).all()


@pytest.mark.slow
def test_the_second_experiment_reuses_the_pretraining_of_the_first(finished):
    assert "pre-training" not in [line for line in finished["param_shift"].stderr.splitlines() if "cache" in line]
    reused = [line for line in finished["external_force"].stderr.splitlines() if "as found in the cache" in line]
    assert len(reused) == 3
    assert all("pre-training" in line for line in reused)


@pytest.mark.slow
@pytest.mark.usefixtures("heard")
@pytest.mark.parametrize(("sent", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)], ids=["TERM", "INT"])
def test_a_signal_saves_the_state_and_a_second_run_is_refused(sent, code, folder, finished):
    forever = ["--patience.hybrid-pretraining.minimum", "10000000", "--max-epochs", "10000000"]
    options = ["--preset", "smoke", "--models", "physics_only", *forever, "--cache", str(folder / "cache")]
    run = [sys.executable, "-m", "experiments.param_shift", *options, "--out", str(folder / sent.name)]
    with subprocess.Popen(run, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        try:
            assert any(": training " in line for line in process.stderr)  # said after a few seconds of training
            if sent == signal.SIGTERM:
                second = subprocess.run(run, capture_output=True, text=True, cwd=ROOT, timeout=120)
                assert "another run is writing" in refused(second, "param_shift")
            process.send_signal(sent)
            rest = process.stderr.read()
            assert process.wait(timeout=60) == code
        finally:
            process.kill()
    assert "the same command goes on from here" in rest
    assert ("Ctrl-C again" in rest) == (sent == signal.SIGINT)
    (begun,) = (folder / "cache" / "stages").glob("pre-training-physics_only-*.begun")
    shutil.rmtree(begun)


REFUSED = {
    "param_shift": [
        (("--preset", "nonsense"), "--preset must be one of paper, quick, smoke, got 'nonsense'"),
        (("--no-such-option", "1"), "--no-such-option"),
    ],
    "comparison": [
        (("--methods", "hybrid", "hybrid"), "--methods must be at least one, each different"),
        (("--residual-inputs", "no_xy"), "--methods last_layer needs a residual that sees"),
        (("--residual-outputs", "accelerations"), "no_physics must write all derivatives"),
        (
            ("--n-target", "20", "3", "--batch-size", "3"),
            "--n-target must each be more than the 9 parameters of constant",
        ),
        (("--encoding.box", "2", "0.5"), "--encoding.box must be two factors, low < high, above 0"),
    ],
    "coverage": [(("--seeds", "2"), "--seeds must be at least 3, got 2")],
    "changes": [(("--n-target", "100", "300"), "--n-target must be one number")],
    "excitation": [
        (("--change", "rain"), "--change must be one of source, parameter_shift"),
        (("--seconds", "30"), "--seconds must be from 3 to 11"),
        (("--bounds.low", "0", "0", "5"), "low must be below high, else the box is empty"),
    ],
    "online": [(("--latency", "0.015"), "latency must be a multiple")],
    "reaction_diffusion": [
        (("--points", "4"), "--points must be at least 8"),
        (("--n-target", "2", "1"), "--n-target must be in ascending order"),
    ],
    "closed_loop": [
        (("--references", "hover", "--away-references", "low_pass"), "--away-references must be among --references"),
        (("--seconds", "0.2"), "--seconds must be at least 1"),
    ],
}


@pytest.mark.parametrize(
    ("name", "options", "said"), [(name, *case) for name, cases in REFUSED.items() for case in cases], ids=str
)
def test_wrong_options_are_refused_in_one_line(name, options, said, tmp_path):
    assert said in refused(unbegun(name, *smallest(*options, folder=tmp_path)), name)
    assert not list(tmp_path.iterdir())


def test_an_out_that_is_a_file_is_refused_and_kept(tmp_path):
    out = tmp_path / "precious"
    out.write_text("mine")
    assert "--out" in refused(unbegun("external_force", *smallest(folder=tmp_path, out=out)), "external_force")
    assert out.read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["precious"]


@pytest.mark.slow
@pytest.mark.parametrize("pattern", ["flights-source-*.npz", "stages/pre-training-hybrid-*.npz"])
def test_a_truncated_file_in_the_cache_is_named_and_nothing_is_overwritten(pattern, folder, finished):
    file = min((folder / "cache").glob(pattern))
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    try:
        with pytest.raises(ValueError, match=re.escape(str(file))):
            study(PARAMETER_SHIFT, IRIS, replace(SMOKE, cache=folder / "cache"), Console(quiet=True))
        assert file.read_bytes() == content[: len(content) // 2]
    finally:
        file.write_bytes(content)


def test_sine_floor_is_the_mean_error_over_phases():
    """Integrated numerically over phases: the path that A/m sin(ω t + φ) alone makes from rest."""
    mass, times = 1.5, 0.1 * np.arange(1, 11)
    phases = 2 * np.pi * np.arange(400) / 400  # equally spaced: the mean over a phase is exact
    fine = np.linspace(0, 1, 10_001)
    push = np.sin(2 * np.pi / 3 * fine + phases[:, None]) / mass

    velocity = cumulative_trapezoid(push, fine, initial=0)
    squares = (velocity**2 + cumulative_trapezoid(velocity, fine, initial=0) ** 2)[:, 1000::1000]
    # The trapezoidal rule at a step of 1e-4 is good to 1e-8.
    np.testing.assert_allclose(sine_floor(mass, times), squares.mean(), rtol=1e-6)
