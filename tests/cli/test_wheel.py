"""The wheel as a stranger uses it, outside the checkout: from logs of every format to pages and a program in C."""

import json
import re
import shutil
import signal
import subprocess
import time

import jax
import numpy as np
import pytest
from recorded import LOGS, READING, of_every_format, write, written
from smoke import ROOT
from writers import MAP

from experiments.real_flight.simulated import vehicle_toml
from experiments.worlds.flights import WORLDS
from hybrid_jax import IRIS, load, load_vehicle, rigid_body, rollout, save
from hybrid_jax.cli.command import VERBS
from hybrid_jax.flights import FlightLog
from hybrid_jax.sim import PARAMETER_SHIFT

X, U = [0, 0, 1, 1, 0, 0, 0, 0.3, 0, 0, 0, 0, 0.1], [650, 640, 650, 660]
MAIN = """
#include <stdio.h>
#include "iris.h"
int main(void) {
    float x[IRIS_STATE_SIZE] = {%s}, u[IRIS_INPUT_SIZE] = {%s}, next[IRIS_STATE_SIZE];
    iris_step(x, u, next);
    for (int i = 0; i < IRIS_STATE_SIZE; ++i) { printf("%%.7g\\n", (double)next[i]); }
    return 0;
}
"""
FILES = ("own.csv", "px4.ulg", "ros.bag", "usd00", "z.bbl")


def are_fine(folder, seen):
    """The pages of verbs show all their figures, nothing beyond their frame, and no error."""
    pages = {path.parent.name: path.read_text() for path in (folder / "runs").glob("*/report.html")}
    for name, found in seen(pages).items():
        assert (found["hidden"], found["wide"]) == (0, False), name
        assert found["images"] > 0, name
    return set(pages)


def runs_as(model, folder):
    """The program in C gives the step of a model."""
    if gcc := shutil.which("gcc"):
        (folder / "main.c").write_text(MAIN % tuple(", ".join(map(str, each)) for each in (X, U)))
        sources = sorted(path.name for path in folder.glob("*.c"))
        subprocess.run([gcc, "-std=c99", "-Wall", "-Werror", *sources, "-lm", "-o", "main"], check=True, cwd=folder)
        found = subprocess.run(["./main"], capture_output=True, check=True, cwd=folder).stdout.split()
        field = load(model).field
        start = np.pad(np.array(X, "f4"), (0, field.hidden))
        expected = rollout(field, start, np.array([U], "f4"), 0.01)[0]
        np.testing.assert_allclose(np.array(found, float), expected, atol=1e-4)


def test_logs_of_every_format_are_read_and_a_model_becomes_a_program(tmp_path, ran, seen):
    of_every_format(tmp_path / "logs", LOGS[:5])
    (tmp_path / "map.toml").write_text(MAP)
    ran(tmp_path, f"inspect logs {READING}")
    rows = json.loads((tmp_path / "runs" / "inspect" / "report.json").read_text())["rows"]
    assert [row["log"] for row in rows if "not read" not in row["result"]] == sorted(FILES)
    save(tmp_path / "body.npz", rigid_body(IRIS, ()), {"dt": 0.01})  # a filter of its parameters takes many seconds
    ran(tmp_path, "export body.npz -o board --name iris")
    runs_as(tmp_path / "body.npz", tmp_path / "board")
    are_fine(tmp_path, seen)


@pytest.mark.slow
def test_from_logs_of_every_format_to_pages_and_a_program(fitted, ran, seen):
    def report(verb):
        return json.loads((fitted / "runs" / verb / "report.json").read_text())

    vehicle = "--write-vehicle written.toml --mass 1.5 --arm 0.25"
    ran(fitted, f"inspect before --vehicle v.toml {READING} {vehicle}")
    assert "4 of 5 logs are ready" in report("inspect")["answer"]
    assert load_vehicle(fitted / "written.toml").rotors == 4
    assert sorted(report("fit")["learned_from"]) == sorted(FILES)[:4]
    assert "Changed: " in ran(fitted, "adapt source.npz after -o adapted.npz")
    assert report("adapt")["parameters"]["Iy"]["value"] == pytest.approx(0.02, rel=0.2)
    assert report("adapt")["parameters"]["Iy"]["low"] < 0.02 * 1.2
    written(fitted / "other", PARAMETER_SHIFT, 1, 2)
    assert "times as accurate as with frozen rates" in ran(fitted, "check adapted.npz other")
    assert set(report("check")["rmse"]) >= {"model", "no forces"}
    ran(fitted, "plan adapted.npz -o plan.csv --seconds 2 --starts 1 --iterations 5")
    ran(fitted, "replay adapted.npz other/flight0.csv.gz --other source.npz --seconds 1")
    (fitted / "commands.toml").write_text((fitted / "v.toml").read_text() + "[actuator]\ncurve = [48.0, 1999.0]\n")
    options = "--learn Ix,Iy --windows 20 --ignore-checks --out runs/identified"
    ran(fitted, f"fit before/z.bbl -o body.npz --vehicle commands.toml {options}")
    ran(fitted, "export adapted.npz -o board --name iris")
    runs_as(fitted / "adapted.npz", fitted / "board")
    guide = (ROOT / "docs" / "howto" / "tool.md").read_text()
    for verb in VERBS:
        (listed,) = re.findall(rf"^- `{verb}`:(.*?)^(?:- |\n)", guide, flags=re.MULTILINE | re.DOTALL)
        assert {*report(verb)} - {"format", "verb", "answer", "notes"} <= {*re.findall(r"`(\w+)`", listed)}, verb
    assert are_fine(fitted, seen) == {*VERBS, "identified"}


@pytest.mark.slow
def test_flights_of_another_simulator_become_an_adapted_model(tmp_path, ran):
    """RotorPy's Hummingbird, whose aerodynamics are not ours, with noise and averaged rotor speeds."""
    world, rng = WORLDS["hummingbird"], np.random.default_rng(0)
    for seed, (folder, change) in enumerate({"before": "nothing", "after": "parameter_shift"}.items()):
        flown = world.fly(change, "moving", 4, 11.0, jax.random.key(seed))
        logs = zip(flown.states[:, :-1], flown.averaged, strict=True)
        times = 0.01 * np.arange(flown.averaged.shape[1])
        write(tmp_path / folder, [FlightLog(times, measured(x, rng), u, f"{i}.csv") for i, (x, u) in enumerate(logs)])
    (tmp_path / "v.toml").write_text(vehicle_toml(world.vehicle))
    ran(tmp_path, "fit before -o source.npz --vehicle v.toml")
    assert "Changed: " in ran(tmp_path, "adapt source.npz after -o adapted.npz")
    found = json.loads((tmp_path / "runs" / "adapt" / "report.json").read_text())["parameters"]
    for name, true in zip(("Ix", "Iy"), world.changed("parameter_shift").inertia, strict=False):
        assert found[name]["value"] == pytest.approx(true, rel=0.05)


def measured(x, rng):
    x = x + np.repeat([1e-3, 1e-3, 0.02, 0.02], [3, 4, 3, 3]) * rng.normal(size=x.shape)
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    return x


@pytest.mark.slow
def test_ctrl_c_is_answered_while_a_program_is_compiled(tmp_path, script):
    save(tmp_path / "body.npz", rigid_body(IRIS), {"dt": 0.02})
    given = [script, "plan", "body.npz", "-o", "plan.csv", "--starts", "1", "--bandwidth", "1.9"]
    environment = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache"), "HOME": str(tmp_path)}
    with subprocess.Popen(given, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment) as process:
        assert process.stderr is not None
        assert "searching" in process.stderr.readline()
        time.sleep(3)
        began = time.perf_counter()
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 128 + signal.SIGINT
        assert time.perf_counter() - began < 1
        assert process.stderr.read() == "hybrid-jax plan: interrupted; each file that was written is complete\n"
