"""The command that identifies a vehicle: bad input ends in one line, a small log in a report and a model."""

import json
from typing import Any

import numpy as np
import pytest

import hybrid_jax as hj
from hybrid_jax.cli.command import NOTHING_CHANGED
from hybrid_jax.cli.identify import _by_step, _nearest
from hybrid_jax.vehicle import IRIS

VEHICLE = f"""
learn = ["k", "time_constant"]
[vehicle]
mass = {IRIS.mass}
inertia = {list(IRIS.inertia)}
thrust_coefficient = {IRIS.thrust_coefficient}
torque_coefficient = {IRIS.torque_coefficient}
rotor_positions = {[list(each) for each in IRIS.rotor_positions]}
spin = {list(IRIS.spin)}
max_rotor_speed = 1100.0
[actuator]
curve = [100.0, 900.0]
time_constants = 0.05
"""
COLUMNS = """
frames = { world = "ENU", body = "FLU", velocity = "world" }
time = { columns = ["t"], unit = "s" }
specific_force = { columns = ["ax", "ay", "az"], unit = "m/s²" }
motors = { columns = ["c0", "c1", "c2", "c3"], unit = "share" }
"""


@pytest.fixture
def files(tmp_path):
    """A rig that shakes its thrust: k is a tenth more than nominal, the lag 0.08 s."""
    rng, dt = np.random.default_rng(0), 0.01
    t = dt * np.arange(1600)
    c = np.repeat(rng.uniform(0.45, 0.75, 100), 16)
    w = np.empty_like(c)
    speed = 100 + 900 * c[0]
    for i, told in enumerate(c):
        w[i] = speed
        speed += (100 + 900 * told - speed) * (1 - np.exp(-dt / 0.08))
    force = 4 * 1.1 * IRIS.thrust_coefficient * w**2 / IRIS.mass + rng.normal(0, 0.1, len(t))
    for name in ("one", "two"):
        table = np.column_stack([t, rng.normal(0, 0.1, (len(t), 2)), force, *[c] * 4])
        path = tmp_path / "logs" / f"{name}.csv"
        path.parent.mkdir(exist_ok=True)
        np.savetxt(path, table, "%.9g", ",", header="t,ax,ay,az,c0,c1,c2,c3", comments="")
    (tmp_path / "vehicle.toml").write_text(VEHICLE)
    (tmp_path / "columns.toml").write_text(COLUMNS)
    options = {"vehicle": "vehicle.toml", "columns": "columns.toml", "output": "model.npz", "out": "out"}
    return tmp_path, [str(tmp_path / "logs"), *(f"--{key}={tmp_path / value}" for key, value in options.items())]


def test_a_folder_of_commands_becomes_a_page_and_a_model(files, called):
    folder, arguments = files
    short = ["--dt", "0.01", "--steps", "40", "--windows", "20"]
    (folder / "logs" / "two.csv").rename(folder / "two.csv")
    assert "2 of 2 parameters are identified" in called("fit", *arguments, *short)[1]
    model: Any = hj.load(folder / "model.npz").field
    theta = model.theta()
    np.testing.assert_allclose(theta["k"], 1.1 * IRIS.thrust_coefficient, rtol=0.01)
    np.testing.assert_allclose(theta["time_constant"], 0.08, rtol=0.05)
    assert json.loads((folder / "out" / "report.json").read_text())["parameters"]["k"]["low"] > 0
    options = ["--columns", folder / "columns.toml", "--out", folder / "out"]
    code, said, _ = called("check", folder / "model.npz", folder / "two.csv", *options)
    assert (code, "After 0.4 s its RMS errors are: specific_force" in said) == (0, True)
    code, _, why = called("check", folder / "model.npz", folder / "logs", *options)
    assert (code, why.splitlines()[-1].endswith("which the model was trained on; leave it out")) == (2, True)
    code, said, _ = called("adapt", folder / "model.npz", folder / "two.csv", "-o", folder / "after.npz", *options)
    assert (code, "These logs show no change." in said) == (NOTHING_CHANGED, True), said
    table = np.genfromtxt(folder / "two.csv", delimiter=",", names=True)
    table["az"] *= 0.8
    np.savetxt(folder / "weak.csv", table, "%.9g", ",", header="t,ax,ay,az,c0,c1,c2,c3", comments="")
    code, said, _ = called("adapt", folder / "model.npz", folder / "weak.csv", "-o", folder / "after.npz", *options)
    assert (code, "Changed: k from " in said) == (0, True)
    found = json.loads((folder / "out" / "report.json").read_text())["parameters"]["k"]["value"]
    np.testing.assert_allclose(found, 0.8 * 1.1 * IRIS.thrust_coefficient, rtol=0.01)


def test_errors_are_shown_at_steps_that_were_measured():
    """By default steps are of 5 ms, and a log at 100 Hz has samples at every second one: the tables were nan."""
    part = np.full((3, 20, 2), np.nan)
    part[:, 1::2] = 0.5
    steps, errors = _by_step(part)
    np.testing.assert_array_equal(steps, np.arange(2, 21, 2))
    np.testing.assert_array_equal(errors, np.full((10, 2), 0.5))
    assert _nearest(part, 5, 0.005) == "0.5  0.5 (0.02 s)"
    assert _nearest(part, 20, 0.005) == "0.5  0.5"


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--learn", "gain"], "'gain'"),
        (["--windows", "0"], "--windows must be an integer of at least 1"),  # it named a field that is no option
        (["--learn", "k,motor_time_constant"], "is for rotor speeds, not for commands: give --learn k"),
        (["--motor-order", "0,1,2,2"], "--motor-order must be of 0, 1, 2, 3, each at most once"),
    ],
)
def test_bad_options_end_in_one_line(files, called, more, said):
    code, _, printed = called("fit", *files[1], *more)
    assert code == 2
    assert said in printed.splitlines()[-1]
