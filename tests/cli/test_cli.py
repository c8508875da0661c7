"""The console script as a user meets it: help, refusals, and fit, adapt and check on logs that tests write."""

import json
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image
from smoke import ROOT

from experiments.real_flight.simulated import csv_of, vehicle_toml
from hybrid_jax.cli import main
from hybrid_jax.cli.command import BAD_INPUT, FAILED_CHECKS, NOTHING_CHANGED, VERBS
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.io.models import save
from hybrid_jax.sim import PARAMETER_SHIFT, SOURCE, random_flights
from hybrid_jax.vehicle import IRIS


def test_help_lists_the_verbs(capsys):
    main([])
    said = capsys.readouterr().out
    assert all(f"  {verb} " in said for verb in VERBS)


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_a_verb_has_at_most_a_dozen_options(called, verb):
    code, said, _ = called(verb, "--help")
    assert code == 0
    assert len(re.findall(r"│ +(?:-\w, )?--(?!help)[a-z-]+", said)) <= 12


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fitt"], "hybrid-jax fitt: no such verb; did you mean fit?; see hybrid-jax --help"),
        (["check", "m.npz", "flights", "--otu", "x"], "did you mean --out?"),
        (["inspect", "none"], "hybrid-jax inspect: none: no such file or folder"),
        (["check", "none.npz", "flights"], "none.npz"),
        (["fit", "none", "-o", "m.npz", "--vehicle", "none.toml"], "none.toml: not a readable TOML file"),
    ],
)
def test_bad_input_ends_in_one_line(tmp_path, monkeypatch, called, arguments, words):
    monkeypatch.chdir(tmp_path)
    code, _, said = called(*arguments)
    assert code == BAD_INPUT
    (line,) = said.splitlines()
    assert words in line


def written(folder, domain, flights, seed, seconds=11.0):
    """A folder of simulated flights."""
    flown = random_flights(domain, flights, seconds, jax.random.key(seed))
    folder.mkdir()
    for i in range(flights):
        x, u = np.asarray(flown.states[i, :-1]), np.asarray(flown.inputs[i])
        (folder / f"flight{i}.csv.gz").write_bytes(csv_of(0.01 * np.arange(len(u)), x, u))
    return folder


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Flights before and after other moments of inertia, and a model of those before."""
    root = tmp_path_factory.mktemp("cli")
    (root / "v.toml").write_text(vehicle_toml(IRIS))
    for name, domain, flights, seed in (("before", SOURCE, 2, 0), ("after", PARAMETER_SHIFT, 2, 1)):
        written(root / name, domain, flights, seed)
    options = ["-o", root / "source.npz", "--vehicle", root / "v.toml", "--out", root / "fit"]
    with pytest.raises(SystemExit) as stop:
        main(["fit", str(root / "before"), *map(str, options)])
    assert not stop.value.code
    return root


@pytest.mark.slow
def test_from_two_folders_to_what_changed(fitted, called):
    after, out = fitted / "after", fitted / "adapt"
    code, said, _ = called("adapt", fitted / "source.npz", after, "-o", fitted / "adapted.npz", "--out", out)
    assert code == 0
    assert "Changed: " in said
    record = json.loads((out / "report.json").read_text())
    found = record["parameters"]["Iy"]
    assert found["low"] < 0.02 * 1.2
    assert found["value"] == pytest.approx(0.02, rel=0.2)
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 1
    assert 'src="http' not in page


@pytest.mark.slow
def test_predictions_are_compared_with_the_simplest(fitted, called):
    options = ["check", fitted / "source.npz", fitted / "after", "--out", fitted / "check"]
    code, said, _ = called(*options)
    assert code == 0
    assert "times as exact as with frozen rates" in said
    assert set(json.loads((fitted / "check" / "report.json").read_text())["rmse"]) >= {"model", "no forces"}


@pytest.mark.slow
def test_a_flight_is_shown_with_what_a_model_expects(fitted, called):
    flight, out = fitted / "after" / "flight0.csv.gz", fitted / "replay"
    options = ["--other", fitted / "source.npz", "--seconds", 1, "--out", out]
    code, said, _ = called("replay", fitted / "source.npz", flight, *options)
    assert code == 0
    assert "0.5 s ahead it is " in said
    assert 'src="data:image/gif;base64,' in (out / "report.html").read_text()
    with Image.open(out / "replay.gif") as picture:
        assert picture.n_frames == 10  # pyright: ignore[reportAttributeAccessIssue]
    verify = [sys.executable, "-m", "rerun", "rrd", "verify", out / "replay.rrd"]
    assert subprocess.run(verify, capture_output=True, check=False).returncode == 0


@pytest.mark.slow
def test_set_points_of_a_plan_begin_and_end_in_the_middle(tmp_path, called):
    save(tmp_path / "model.npz", rigid_body(IRIS), {"dt": 0.02})
    files = ["-o", tmp_path / "plan.csv", "--out", tmp_path]
    code, said, _ = called("plan", tmp_path / "model.npz", *files, "--seconds", 2, "--starts", 1, "--steps", 0)
    assert code == 0
    assert "is told worst" in said
    points = np.genfromtxt(tmp_path / "plan.csv", delimiter=",", names=True)
    assert points.dtype.names == ("t", "px", "py", "pz", "yaw", "vx", "vy", "vz")
    np.testing.assert_allclose([*points[0]][1:], [0, 0, 1.75, 0, 0, 0, 0], atol=1e-5)
    np.testing.assert_allclose([*points[-1]][1:], [0, 0, 1.75, 0, 0, 0, 0], atol=1e-4)
    assert np.ptp(points["px"]) > 0.01


@pytest.mark.slow
def test_a_flight_that_the_model_learned_from_is_refused(fitted, called):
    shutil.copy(fitted / "before" / "flight0.csv.gz", fitted / "copy.csv.gz")
    code, _, said = called("check", fitted / "source.npz", fitted / "copy.csv.gz", "--out", fitted / "check")
    assert code == BAD_INPUT
    assert "copy.csv.gz: the same flight as flight0.csv.gz, which the model learned from" in said


@pytest.mark.slow
def test_logs_that_fail_all_checks_are_no_flights(fitted, tmp_path, called):
    flown = random_flights(PARAMETER_SHIFT, 1, 11.0, jax.random.key(5))
    x, u = np.asarray(flown.states[0, :-1]), np.asarray(flown.inputs[0])
    (tmp_path / "mm.csv.gz").write_bytes(csv_of(0.01 * np.arange(len(u)), x * np.repeat([1000.0, 1.0], [3, 10]), u))
    code, _, said = called("check", fitted / "source.npz", tmp_path / "mm.csv.gz", "--out", tmp_path)
    assert code == FAILED_CHECKS
    assert "position is in mm" in said


@pytest.mark.slow
def test_nothing_changed_has_an_exit_code_of_its_own(fitted, tmp_path, called):
    same = written(tmp_path / "same", SOURCE, 1, 7)
    options = ["-o", tmp_path / "adapted.npz", "--out", tmp_path / "out"]
    code, said, _ = called("adapt", fitted / "source.npz", same, *options)
    assert (code, (tmp_path / "adapted.npz").exists()) in ((NOTHING_CHANGED, False), (0, True))
    if code:
        assert "Nothing changed" in said


@pytest.mark.slow
def test_the_wheel_holds_the_script(tmp_path):
    """In an environment that sees the packages of this one, and nothing of the checkout."""
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path, ROOT]
    subprocess.run(build, check=True)
    venv.create(tmp_path / "env", system_site_packages=True, symlinks=True)
    site = next((tmp_path / "env").glob("lib/python*/site-packages"))
    (site / "parent.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    (wheel,) = tmp_path.glob("*.whl")
    python = tmp_path / "env" / "bin" / "python"
    install = [python, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--force-reinstall", wheel]
    subprocess.run(install, check=True, env={}, cwd=tmp_path)
    said = subprocess.run([python.with_name("hybrid-jax")], capture_output=True, text=True, env={}, cwd=tmp_path)
    assert "fit" in said.stdout, said.stderr
    where = [python, "-c", "import hybrid_jax; print(hybrid_jax.__file__)"]
    found = subprocess.run(where, capture_output=True, text=True, env={}, cwd=tmp_path).stdout
    assert Path(found.strip()).is_relative_to(tmp_path)
