"""A small log becomes a model and its page; options, and logs that would teach a wrong vehicle, are refused."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from recorded import LOGS, write
from writers import column_map

import hybrid_jax as hj
from benchmarks.log_mistakes import parts_of, recording_of
from experiments.real_flight.simulated import vehicle_toml
from hybrid_jax.cli.command import NOTHING_CHANGED, ChecksFailed
from hybrid_jax.cli.fit import Options
from hybrid_jax.cli.identify import _by_step, _nearest, checked
from hybrid_jax.dynamics import Actuator, VehicleModel
from hybrid_jax.flights.checks.consistency import FAILS
from hybrid_jax.identification.log_checks import compared
from hybrid_jax.vehicle import IRIS

COLUMNS = column_map(time=("t", "s"), specific_force=("ax ay az", "m/s²"), motors=("c0 c1 c2 c3", "share"))


@pytest.fixture
def files(tmp_path):
    """A rig that shakes its thrust: k is a tenth more than nominal, the lag 0.08 s."""
    rng, dt = np.random.default_rng(0), 0.01
    t = dt * np.arange(800)
    c = np.repeat(rng.uniform(0.45, 0.75, 50), 16)
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
    known = f"{vehicle_toml(IRIS)}{ACTUATOR}time_constants = 0.05\n"
    (tmp_path / "vehicle.toml").write_text('learn = ["k", "time_constant"]\n' + known)
    (tmp_path / "columns.toml").write_text(COLUMNS)
    options = {"vehicle": "vehicle.toml", "columns": "columns.toml", "output": "model.npz", "out": "out"}
    return tmp_path, [str(tmp_path / "logs"), *(f"--{key}={tmp_path / value}" for key, value in options.items())]


def test_a_folder_of_commands_becomes_a_page_and_a_model(files, called):
    folder, arguments = files
    short = ["--dt", "0.01", "--steps", "40"]  # all windows are fitted, so that all commands share their programs
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


ACTUATOR = "[actuator]\ncurve = [100.0, 900.0]\n"
SWAPPED = replace(LOGS[0], u=LOGS[0].u[:, [1, 2, 3, 0]])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "v.toml").write_text('learn = ["Ix", "curve"]\n' + vehicle_toml(IRIS) + ACTUATOR)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def read_logs(folder, **options):
    options = Options(folder / "logs", folder / "m.npz", **options)
    return checked(options, folder / "v.toml", VehicleModel(IRIS))[0]


def test_a_check_that_fails_ends_in_what_to_type_and_goes_on_when_asked_or_mended(folder):
    write(folder / "logs", [SWAPPED])
    (folder / "logs" / "notes.txt").write_text("windy")
    with pytest.raises(ChecksFailed, match="motor order against roll and pitch") as failed:
        read_logs(folder)
    assert failed.value.args[0].endswith("motor_order=(3, 0, 1, 2)")
    assert "nothing was identified" in failed.value.args[-1]
    for more, failed in (({"ignore_checks": True}, 1), ({"motor_order": (3, 0, 1, 2)}, 0)):  # asked, and mended
        read = read_logs(folder, **more)
        assert [f"{failed} checks" in line for line in read.warnings if "--ignore-checks" in line] == [True] * failed
    write(folder / "logs", [LOGS[1]])
    read = read_logs(folder)  # what fails is left out where another log passes
    assert [*read.contents] == ["chirp_run2.csv.gz"]
    assert "motor order against roll and pitch" in read.notes[-1]


@pytest.mark.parametrize(("learn", "rest"), [("Ix,curve,delay", "Ix"), ("curve", "Ix Iy")])
def test_what_speeds_do_not_tell_is_refused(folder, called, learn, rest):
    """It vanished from the result."""
    write(folder / "logs", LOGS[:1])
    code, _, said = called("fit", "logs", "-o", "model.npz", "--vehicle", "v.toml", "--learn", learn)
    (line,) = said.splitlines()
    assert code == 2
    assert line.startswith("hybrid-jax fit: v.toml: learn: curve")
    assert line.endswith(f"has only rotor speeds: give --learn {rest}")


def failed(recording, learn=("k", "Ix"), vehicle=IRIS):
    """Names of the checks that fail; commands are told by the curve of `ACTUATOR`."""
    model = VehicleModel(vehicle, actuator=Actuator((100.0, 900.0)), learn=learn)
    field = model.commanded() if "command" in recording.signals else model.physics()
    return [check.name for check in compared(recording, field, learn) if check.verdict == FAILS]


def commanded(log, *left_out):
    """A recording of commands, without some signals."""
    recording = recording_of(parts_of(log))
    speeds = recording.signals["rotor_speed"]
    signals = {name: signal for name, signal in recording.signals.items() if name not in ("rotor_speed", *left_out)}
    return replace(recording, signals=signals | {"command": replace(speeds, values=(log.u - 100) / 900)})


def test_a_gyro_alone_tells_the_order_of_the_motors_and_states_are_compared_with_what_there_is():
    without = ("position", "velocity", "attitude")
    assert failed(commanded(LOGS[0], *without)) == []
    assert failed(commanded(SWAPPED, *without)) == ["motor order against roll and pitch"]
    assert failed(commanded(SWAPPED, *without, "rates")) == []
    x = LOGS[0].x.copy()
    x[:, 7:10] = -x[:, 7:10]
    backwards = replace(LOGS[0], x=x)
    assert "dp/dt against v" in failed(commanded(backwards))
    assert failed(commanded(backwards, "position", "attitude")) == []


def test_a_thrust_that_is_learned_may_be_off_but_not_in_another_unit_and_slow_signals_are_no_fast_ones():
    weak, ratio = replace(IRIS, thrust_coefficient=IRIS.thrust_coefficient / 3), "specific force over thrust per mass"
    assert ratio not in failed(recording_of(parts_of(LOGS[0])), vehicle=weak)
    assert ratio in failed(recording_of(parts_of(LOGS[0])), learn=("Ix",), vehicle=weak)
    rpm = replace(LOGS[0], u=LOGS[0].u * 30 / np.pi)
    assert ratio in failed(recording_of(parts_of(rpm)))
    # What a motor did between commands 40 ms apart is not known.
    recording = commanded(SWAPPED)
    slow = dict(recording.signals)
    for name, k in (("position", 20), ("command", 4)):
        slow[name] = replace(slow[name], t=slow[name].t[::k], values=slow[name].values[::k])
    assert failed(replace(recording, signals=slow)) == []
