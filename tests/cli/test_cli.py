"""The console script as a user meets it: help, refusals, verbs on logs that tests write, and pages in a browser."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from matplotlib.figure import Figure
from smoke import ROOT

from experiments.real_flight.simulated import csv_of, vehicle_toml
from hybrid_jax import Adaptation, load, rigid_body, save
from hybrid_jax.cli.command import BAD_INPUT, FAILED_CHECKS, NOTHING_CHANGED, VERBS, in_flags
from hybrid_jax.cli.export import PARTS
from hybrid_jax.cli.logs import Flights
from hybrid_jax.cli.page import Page, Table, document, write
from hybrid_jax.flights import FlightLog
from hybrid_jax.status import Status
from hybrid_jax.vehicle import IRIS, SENSOR_NOISE, load_vehicle


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_a_verb_has_at_most_twenty_lines_and_a_dozen_options(called, verb, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, said, _ = called(verb, "--help")
    assert (code, len(said.splitlines()) <= 20) == (0, True)
    options = set(re.findall(r"^  (?:-\w, )?(--[a-z-]+)", said, flags=re.MULTILINE))
    assert 4 <= len(options) <= 12
    code, every, _ = called(verb, "--help-all")
    assert options <= set(re.findall(r"--[a-z-]+", every))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fitt"], "hybrid-jax fitt: no such verb; did you mean fit?; see hybrid-jax --help"),
        (["check", "--otu", "x"], "Unrecognized options: --otu; did you mean --out?"),  # besides, arguments are missing
        (["inspect", "no\x1b[31mne"], r"hybrid-jax inspect: no\x1b[31mne: no such file or folder"),
        (["fit", "none", "-o", "m.npz", "--vehicle", "none.toml"], "none.toml: not a readable TOML file"),
        (["fit", "flights", "-o", "flights"], "--output flights: is a folder; name a file in it"),
        (["fit", "flights"], "an argument is missing; usage: hybrid-jax fit BEFORE --output PATH [OPTIONS]"),
        (["fit", "flights", "-o", "v.toml/m.npz"], "--output v.toml: cannot be written"),
        (["plan", "m.npz", "-o", "p.csv", "--low", "a,b,c"], "--low must be 3 numbers, got a b c"),
        (["export", "m.npz", "-o", "board", "--dt", "fast"], "--dt must be a number, got fast"),
        (["inspect", "flights", "--write-vehicle", "v.toml"], "v.toml exists; name another file"),
        (["inspect", "flights", "--topics", "/odom"], "inspect: --topics must be pairs like"),
        (["inspect", "flights", "--dt", "0"], "inspect: --dt must be a positive"),
        (["inspect", "flights", "--columns", "v.toml"], "'vehicle': must be one of frames"),
        (["inspect", "flights", "--vehicle", "v.toml"], "v.toml: learn must be names of"),
        (["inspect", "flights"], "flights: contains no logs, only notes.txt: not a supported format"),
    ],
)
def test_bad_input_ends_in_one_line(tmp_path, monkeypatch, called, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flights").mkdir()
    (tmp_path / "flights" / "notes.txt").write_text("windy")
    (tmp_path / "v.toml").write_text('learn = ["Ix", "mas"]\n' + vehicle_toml(IRIS))
    save(tmp_path / "m.npz", rigid_body(IRIS), {})
    code, _, said = called(*arguments)
    assert code == BAD_INPUT
    assert words in said.splitlines()[-1]
    assert not [*tmp_path.glob("runs/*/*"), *tmp_path.glob("board/*")]


ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}
PRINTS = r"""
import sys
from hybrid_jax.cli.command import exit_codes
from hybrid_jax.kernels.library import _digest
_digest("")
with exit_codes("hybrid-jax", "inspect", "interrupted"):
    for _ in range(9999):
        print("0.1 \xb1 0.01")
        print("\xbd", file=sys.stderr)
    open(sys.argv[1], "x").close()
"""


@pytest.mark.parametrize("where", ["2>&1 | head -1", "| head -1", "> /dev/full", ">&- 2>&-"])
def test_output_that_cannot_be_written_or_shown_ends_no_run(where, tmp_path):
    command = f'"$0" -c "$1" "$2" {where}; exit ${{PIPESTATUS[0]}}'
    run = ["bash", "-c", command, sys.executable, PRINTS, str(tmp_path / "file")]
    done = subprocess.run(run, cwd=ROOT, env=os.environ | ASCII, capture_output=True)
    assert done.returncode == 0, done.stderr[-300:]
    assert (tmp_path / "file").exists()
    assert (b"hybrid-jax: standard output: No space left" in done.stderr) == (where == "> /dev/full")
    assert b"Broken pipe" not in done.stderr
    assert done.stdout in (b"", b"0.1 ? 0.01\n", b"?\n")


def test_help_may_be_cut_off():
    with Path("/dev/full").open("w") as full:
        assert subprocess.run([sys.executable, "-m", "hybrid_jax"], cwd=ROOT, stdout=full).returncode == 0


def test_physics_that_takes_the_place_of_a_network_is_saved_though_nothing_changed(tmp_path, monkeypatch, called):
    body, n = rigid_body(IRIS), 30
    x = np.tile([0, 0, 1.5, 1, *[0.0] * 9], (n, 1)) + np.arange(n)[:, None] * np.eye(13)[0]  # none is a repeated sample
    windows = {"x0": x[:1].tolist(), "u": [[[500.0] * 4] * 10], "x": [x[1:11].tolist()]}
    save(tmp_path / "m.npz", body, {"dt": 0.01, "steps": 10, "learned_from": {}, "motion": {}, "windows": windows})
    flown = FlightLog(0.01 * np.arange(n), x, np.full((n, 4), 500.0))
    none = dict.fromkeys(("disturbance", "without_intervals"))
    numbers = {"mse_before": 1.0, "mse_after": 1.0, "windows": 2, "steps": 0, "level": 0.95}
    taken = {"chosen": "source", "candidates": {"source": 1.0}, "physics_only": True}
    found = Adaptation(body, "auto", {}, status=Status.OK, **none, **numbers, **taken)
    monkeypatch.setattr("hybrid_jax.cli.adapt.flights_for", lambda *_, **__: Flights([flown], {}, []))
    monkeypatch.setattr("hybrid_jax.cli.adapt.adapted", lambda *_: (body, found))
    files = ["-o", tmp_path / "adapted.npz", "--out", tmp_path]
    code, said, _ = called("adapt", tmp_path / "m.npz", tmp_path, *files)
    assert code == 0
    assert "These flights show no change; of the model only its physics is kept" in said
    assert (tmp_path / "adapted.npz").exists()
    keys = {*json.loads((tmp_path / "report.json").read_text())} - {"format", "verb", "answer", "notes"}
    (listed,) = re.findall(r"^- `adapt`:(.*?)^- ", (ROOT / "docs/howto/tool.md").read_text(), re.MULTILINE | re.DOTALL)
    assert keys <= {*re.findall(r"`(\w+)`", listed)}


@pytest.mark.slow
def test_set_points_of_a_plan_begin_and_end_in_the_middle(tmp_path, called):
    save(tmp_path / "model.npz", rigid_body(IRIS), {"dt": 0.02})
    files = ["-o", tmp_path / "plan.csv", "--out", tmp_path]
    code, said, _ = called("plan", tmp_path / "model.npz", *files, "--seconds", 2, "--starts", 1, "--iterations", 0)
    assert code == 0
    assert "is the least certain" in said
    points = np.genfromtxt(tmp_path / "plan.csv", delimiter=",", names=True)
    assert points.dtype.names == ("t", "px", "py", "pz", "yaw", "vx", "vy", "vz")
    np.testing.assert_allclose([*points[0]][1:], [0, 0, 1.75, 0, 0, 0, 0], atol=1e-5)
    np.testing.assert_allclose([*points[-1]][1:], [0, 0, 1.75, 0, 0, 0, 0], atol=1e-4)
    assert np.ptp(points["px"]) > 0.01


@pytest.mark.slow
def test_a_flight_that_the_model_learned_from_is_refused_and_a_model_of_another_vehicle_told(fitted, called, tmp_path):
    shutil.copy(fitted / "before" / "px4.ulg", fitted / "copy.ulg")
    code, _, said = called("check", fitted / "source.npz", fitted / "copy.ulg", "--out", fitted / "check")
    assert code == BAD_INPUT
    assert "copy.ulg: the same flight as px4.ulg, which the model was trained on" in said
    # Of a vehicle with five times the thrust no change of this one is learned.
    about, other = load(fitted / "source.npz").about, replace(IRIS, thrust_coefficient=5 * IRIS.thrust_coefficient)
    save(tmp_path / "other.npz", rigid_body(other), about)
    files = ["-o", tmp_path / "adapted.npz", "--out", tmp_path]
    code, _, said = called("adapt", tmp_path / "other.npz", fitted / "after", *files)
    assert code == FAILED_CHECKS
    assert "specific force over thrust per mass" in said
    assert not (tmp_path / "adapted.npz").exists()


@pytest.mark.slow
def test_hover_tells_nothing(fitted, tmp_path, called):
    """Of hover with noise alone no number is claimed to have changed, though one that is fitted moves."""
    rng, n = np.random.default_rng(0), 1100
    x = np.tile([0, 0, 1.5, 1, *[0.0] * 9], (n, 1)) + rng.normal(0, np.repeat(SENSOR_NOISE, PARTS), (n, 13))
    squares = np.linalg.pinv(IRIS.mixer) @ [IRIS.mass * IRIS.gravity, 0, 0, 0]  # rotors are not all as far out
    u = np.sqrt(squares) + rng.normal(0, 0.5, (n, 4))
    (tmp_path / "hover.csv.gz").write_bytes(csv_of(0.01 * np.arange(n), x, u))
    files = ["-o", tmp_path / "adapted.npz", "--out", tmp_path]
    code, said, _ = called("adapt", fitted / "source.npz", tmp_path / "hover.csv.gz", *files)
    assert code == NOTHING_CHANGED, said
    assert "These flights show no change." in said
    assert not (tmp_path / "adapted.npz").exists()


@pytest.mark.slow
def test_without_a_vehicle_file_one_is_written_first(fitted, tmp_path, called, monkeypatch):
    monkeypatch.setattr("hybrid_jax.cli.fit.learn", mock.Mock(side_effect=ValueError("learning")))
    code, said, why = called("fit", fitted / "after", "-o", tmp_path / "m.npz", "--out", tmp_path / "fit")
    assert (code, why.splitlines()[-1]) == (BAD_INPUT, "hybrid-jax fit: learning")
    assert "vehicle.toml: written" in said
    assert load_vehicle(tmp_path / "fit" / "vehicle.toml").mass == 1


SAID = {
    "the motors are u3 u0 u1 u2: motor_order=(3, 0, 1, 2)": "the motors are u3 u0 u1 u2: --motor-order 3,0,1,2",
    "name the motors of its rotors: motor_order=…": "name the motors of its rotors: --motor-order",
    "topics: motors must be TOPIC:FIELD:UNIT": "--topics: motors must be TOPIC:FIELD:UNIT",
    'name the columns in a column map: columns="MAP.toml"': "name the columns in a column map: --columns MAP.toml",
    "columns: u0 never changes": "columns: u0 never changes",  # the name of a check
    "v.toml: [motors]: polynomial must be numbers": "v.toml: [motors]: polynomial must be numbers",  # a key
    "polynomial=(c0, c1, …) maps them": "--polynomial c0,c1 maps them",
    "11.9 ms later: delay=0.0119, or learn": "11.9 ms later: --delay 0.0119, or learn",
    'use what is whole: failed="warn"': "use what is whole: --ignore-checks",
}


@pytest.mark.parametrize(("said", "printed"), SAID.items(), ids=SAID)
def test_arguments_become_options(said, printed):
    assert in_flags(said, "real_flight") == printed
    assert in_flags(said, "external_force") == said  # which reads no logs


@pytest.fixture
def page():
    wide = Table("Many < columns", [f"column {i}" for i in range(30)], [[f"{i}.123 m/s" for i in range(30)]])
    figures = [("The one & only <figure>", Figure()), ("Another", Figure())]
    for _, figure in figures:
        figure.subplots().plot([1, 2], [3, 4])
    return Page("What?", "This.", wide, figures, ["a < b"], ["Go on: " + "x" * 200], [wide], ["y" * 300])


def test_a_page_needs_nothing_but_itself(page, tmp_path, capsys):
    write(tmp_path, "check", page, {"one": 1})
    shown = (tmp_path / "report.html").read_text()
    assert re.findall(r"(?:src|href)=\"(?!data:)[^\"]*|url\(|@import|fetch\(", shown) == []
    assert shown.index("This.") < shown.index("<img") < shown.index("<table") < shown.index("<details")
    assert "The one &amp; only &lt;figure&gt;" in shown
    record = json.loads((tmp_path / "report.json").read_text())
    assert list(record) == ["format", "verb", "answer", "notes", "one"]
    *_, header, row, _, _, last = capsys.readouterr().out.splitlines()  # as many columns as a terminal has room for
    assert (header.count("n "), row.count("m/s"), last) == (7, 7, f"page: {tmp_path / 'report.html'}")


def test_a_browser_shows_it_without_an_error(page, seen):
    right = {"images": 2, "hidden": 0, "wide": False}
    assert seen({"page": document(page)}) == {("page", 400): right, ("page", 1400): right}
