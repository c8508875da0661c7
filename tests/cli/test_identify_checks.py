"""Logs are checked before a vehicle is identified from them: what would teach a wrong vehicle ends in exit code 3."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import LOGS, write

from benchmarks.log_mistakes import parts_of, recording_of
from experiments.real_flight.simulated import vehicle_toml
from hybrid_jax.cli.command import ChecksFailed
from hybrid_jax.cli.compared import compared
from hybrid_jax.cli.fit import Options
from hybrid_jax.cli.identify import checked
from hybrid_jax.dynamics.actuators import Actuator
from hybrid_jax.dynamics.vehicle_file import VehicleModel
from hybrid_jax.flights.checks.consistency import FAILS
from hybrid_jax.vehicle import IRIS

ACTUATOR = "[actuator]\ncurve = [100.0, 900.0]\n"
SWAPPED = replace(LOGS[0], u=LOGS[0].u[:, [1, 2, 3, 0]])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "v.toml").write_text('learn = ["Ix", "curve"]\n' + vehicle_toml(IRIS) + ACTUATOR)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_check_that_fails_ends_in_what_to_type(folder):
    write(folder / "logs", [SWAPPED])
    (folder / "logs" / "notes.txt").write_text("windy")
    with pytest.raises(ChecksFailed, match="motor order against roll and pitch") as failed:
        checked(Options(folder / "logs", folder / "m.npz"), folder / "v.toml", VehicleModel(IRIS))
    assert failed.value.args[0].endswith("motor_order=(3, 0, 1, 2)")
    assert "nothing was identified" in failed.value.args[-1]


@pytest.mark.parametrize(("more", "failed"), [({"anyway": True}, 1), ({"motor_order": (3, 0, 1, 2)}, 0)], ids=str)
def test_it_goes_on_when_asked_or_mended(folder, more, failed):
    write(folder / "logs", [SWAPPED])
    read = checked(Options(folder / "logs", folder / "m.npz", **more), folder / "v.toml", VehicleModel(IRIS))
    assert len(read.failed) == failed


def test_a_log_that_fails_is_left_out_where_another_passes(folder):
    write(folder / "logs", [SWAPPED, LOGS[1]])
    read = checked(Options(folder / "logs", folder / "m.npz"), folder / "v.toml", VehicleModel(IRIS))
    assert [*read.contents] == ["chirp_run2.csv.gz"]
    assert (read.failed, "motor order against roll and pitch" in read.said[-1]) == ([], True)


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


def test_commands_and_a_gyro_alone_tell_the_order_of_the_motors():
    without = ("position", "velocity", "attitude")
    assert failed(commanded(LOGS[0], *without)) == []
    assert failed(commanded(SWAPPED, *without)) == ["motor order against roll and pitch"]
    assert failed(commanded(SWAPPED, *without, "rates")) == []


def test_states_are_compared_with_what_there_is_of_them():
    x = LOGS[0].x.copy()
    x[:, 7:10] = -x[:, 7:10]
    backwards = replace(LOGS[0], x=x)
    assert "dp/dt against v" in failed(commanded(backwards))
    assert failed(commanded(backwards, "position", "attitude")) == []


def test_a_thrust_that_is_learned_may_be_off_but_not_in_another_unit():
    weak, ratio = replace(IRIS, thrust_coefficient=IRIS.thrust_coefficient / 3), "specific force over thrust per mass"
    assert ratio not in failed(recording_of(parts_of(LOGS[0])), vehicle=weak)
    assert ratio in failed(recording_of(parts_of(LOGS[0])), learn=("Ix",), vehicle=weak)
    rpm = replace(LOGS[0], u=LOGS[0].u * 30 / np.pi)
    assert ratio in failed(recording_of(parts_of(rpm)))


def test_slow_signals_are_not_compared_as_if_they_were_fast():
    """What a motor did between commands 40 ms apart is not known."""
    recording = commanded(SWAPPED)
    slow = dict(recording.signals)
    for name, k in (("position", 20), ("command", 4)):
        slow[name] = replace(slow[name], t=slow[name].t[::k], values=slow[name].values[::k])
    assert failed(replace(recording, signals=slow)) == []
