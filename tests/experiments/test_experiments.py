"""Experiments and programs from their command lines: help, what a run leaves, and the input that is refused."""

import dataclasses
import json
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from importlib import import_module

import equinox as eqx
import numpy as np
import pytest
from rich.console import Console
from scipy.integrate import cumulative_trapezoid
from smoke import ROOT, experiments, refused, smallest, unbegun

import hybrid_jax as hj
from experiments.external_force import sine_floor
from experiments.identification import emps, record, tanks
from experiments.paper.config import SMOKE
from experiments.paper.lanes import physics_in
from experiments.paper.study import placeholder, study
from experiments.reporting.report import read_record
from experiments.runner.command import MINUTES
from experiments.runner.stages import stages_of
from hybrid_jax.sim import PARAMETER_SHIFT, SplitSpec


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Left by a run of an experiment."""
    folder = tmp_path_factory.mktemp("experiments")
    (run,) = experiments("shifts", "param_shift", folder=folder)
    assert run.returncode == 0, run.stderr
    return folder


@pytest.mark.slow
def test_every_row_has_a_model_that_loads_and_predicts(folder):
    at_rest = placeholder(SplitSpec(2, 5))
    out = folder / "out" / "param_shift"
    rows = read_record(out)["rows"]
    assert len(list((out / "models").iterdir())) == len(rows)
    for row in rows:
        model = hj.load(out / "models" / f"{row['model']}-{row['mode']}-{row['n_train']}-seed{row['seed']}.npz")
        assert model.about["test_mse"] == row["test_mse"]
        if row["theta"] is not None:
            assert {key: float(value) for key, value in physics_in(model.field).theta().items()} == row["theta"]
    predicted = model.predict(at_rest.x0, at_rest.u + hj.IRIS.hover_speed, model.about["dt"])
    assert predicted.shape == (2, 5, 13)
    assert np.isfinite(predicted).all()


@pytest.mark.slow
@pytest.mark.usefixtures("heard")
@pytest.mark.parametrize(("sent", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)], ids=["TERM", "INT"])
def test_a_signal_saves_the_state_and_a_second_run_is_refused(sent, code, folder):
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
        (("--residual-outputs", "accelerations"), "no_physics needs all derivatives"),
        (("--n-target", "20", "3", "--batch-size", "3"), "--n-target must each be more than the 9 parameters"),
        (("--encoding.box", "2", "0.5"), "--encoding.box must be two factors, low < high, above 0"),
    ],
    "coverage": [(("--seeds", "2"), "--seeds must be at least 3, got 2")],
    "changes": [(("--n-target", "100", "300"), "--n-target must be one number")],
    "excitation": [
        (("--change", "rain"), "--change must be one of nothing, parameter_shift"),
        (("--seconds", "30"), "--seconds must be from 3 to 11"),
        (("--low", "0", "0", "5"), "low must be below high, else the box is empty"),
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
def test_a_truncated_file_in_the_cache_is_named_and_nothing_is_overwritten(pattern, folder):
    file = min((folder / "cache").glob(pattern))
    content, config = file.read_bytes(), replace(SMOKE, cache=folder / "cache")
    file.write_bytes(content[: len(content) // 2])
    try:
        with pytest.raises(ValueError, match=re.escape(str(file))):
            study(PARAMETER_SHIFT, hj.IRIS, config, stages_of(config, Console(quiet=True)))
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


@pytest.mark.parametrize("name", ["identification.crazypad", "identification.nanobench"])
@pytest.mark.parametrize(("arguments", "code"), [(["--help"], 0), ([], 2), (["none"], 2)], ids=str)
def test_the_command_line_is_explained_or_refused_in_one_line(name, arguments, code, monkeypatch, capsys):
    """--help was taken for a folder, and without an argument there was a traceback."""
    monkeypatch.setattr("hybrid_jax.runtime.configure", lambda: None)  # JAX has begun in this process
    with pytest.raises(SystemExit) as stop:
        import_module(f"experiments.{name}").main(arguments)
    assert stop.value.code == code
    said = capsys.readouterr()
    assert f"usage: python -m experiments.{name}" in said.out if code == 0 else said.err.startswith(f"{name}: ")
    assert len(said.err.splitlines()) == (code != 0)


PACKAGES = ("changes", "closed_loop", "excitation", "online", "reaction_diffusion", "real_flight")
NAMES = "ablation changes closed_loop comparison coverage excitation external_force online param_shift changes.harm"


@pytest.mark.parametrize("name", [*NAMES.split(), "reaction_diffusion", "real_flight", "make_flights"])
def test_help_has_a_screen_of_options_for_users(name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as stop:
        import_module(f"experiments.{name}{'.__main__' * (name in PACKAGES)}").main(["--help"])
    said = capsys.readouterr().out.splitlines()
    assert stop.value.code == 0
    assert 4 <= sum(line.startswith("  --") for line in said) <= 12
    assert sum(line.startswith("  ") for line in said) <= 20
    assert max(map(len, said)) <= 80


@pytest.mark.parametrize("name", MINUTES)
def test_help_says_how_long_the_full_run_took(name):
    record = json.loads((ROOT / "docs/reference" / name / "report.json").read_text())
    assert record["config"]["preset"] == "paper"
    assert MINUTES[name] == pytest.approx(sum(record["environment"]["seconds"].values()) / 60, rel=0.15)


@pytest.fixture(scope="module")
def slide(tmp_path_factory):
    """Two records of a slide that is pushed to and fro."""
    paths = []
    for name, phase in (("one", 0.0), ("two", 1.0)):
        t = np.arange(0, 6, 0.01)
        u = 90 * np.sin(2 * t + phase) + 40 * np.sin(5.3 * t)
        model, _ = emps.candidate()
        made = hj.Record.of(name, u=(t, u), q=(t, 0 * t))
        q = hj.simulate(model, made, (0.0, 0.0), dt=0.01, between="linear", substeps=2)[0]["q"][:, 0]
        paths.append(str(tmp_path_factory.mktemp("slide") / f"{name}.csv"))
        table = np.column_stack([t, u, q + 1e-4 * np.random.default_rng(0).normal(size=len(t))])
        np.savetxt(paths[-1], table, delimiter=",", header="t,u,q", comments="")
    return paths


@pytest.mark.slow
def test_the_model_that_made_a_record_predicts_another(slide, capsys):
    one = dataclasses.replace(emps.BENCHMARK, candidates={"physics": emps.candidate}, parts=2)
    record.main(one, "identification.emps", [slide[0], "--test", slide[1]])
    said = capsys.readouterr().out
    assert "Chosen: physics" in said
    assert float(said.split("two.csv: ")[1].split(" mm")[0]) < 2.0


def test_a_sensor_with_play_stays_at_a_reversal_and_then_follows():
    field, play = tanks.physics(play=True), 0.15
    rate = field(np.array([4.0, 6.0, 0.0]), np.array([3.0]))[1]
    for z, share in ((0.0, 1.0), (-np.sign(rate) * play, 1.0), (np.sign(rate) * play, 0.0)):
        change = field(np.array([4.0, 6.0, z]), np.array([3.0]))
        np.testing.assert_allclose(change[2], share * change[1], atol=1e-7)


def test_a_network_begins_at_the_physics_and_changes_only_its_states():
    x, u = np.array([4.0, 6.0, 0.1]), np.array([3.0])
    model, _ = tanks.candidate("bend", "play")
    field = record.with_network(tanks.BENCHMARK, model).field
    np.testing.assert_array_equal(field(x, u), model.field(x, u))
    other = eqx.tree_at(lambda field: field.residual.weight, field, replace_fn=lambda weight: weight + 1.0)
    changed = np.asarray(other(x, u) - model.field(x, u))
    np.testing.assert_array_equal(changed != 0, [True, True, False])


def test_a_wrong_record_is_refused_in_a_line(tmp_path, capsys):
    path = tmp_path / "wrong.csv"
    wrong = {"t,u,y\n0,1,2\n": "no column q; it has t, u, y", "t,u,q\n0,x,2\n": "row 2: three numbers"}
    for text, said in {"": "wrong.csv: no such file or directory", **wrong}.items():
        if text:
            path.write_text(text)
        with pytest.raises(SystemExit, match="2"):
            record.main(emps.BENCHMARK, "identification.emps", [str(path)])
        assert said in " ".join(capsys.readouterr().err.split())
