"""`python -m experiments.replay`: a flight in 3-D from the models of a run, or a line that says what is missing."""

import json
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import hybrid_jax as hj
from experiments import replay as command
from hybrid_jax import control
from hybrid_jax.sim.domain import Domain

BEFORE, AFTER = "hybrid-source_only-0-seed0", "hybrid-fine_tuned-20-seed0"


@pytest.fixture
def run(tmp_path):
    """The folder of a run that has a report and two models."""
    (tmp_path / "models").mkdir()
    (tmp_path / "report.json").write_text(json.dumps({"rows": [{"domain": "parameter_shift"}]}))
    for name in (BEFORE, AFTER):
        hj.save(tmp_path / "models" / f"{name}.npz", hj.rigid_body(hj.IRIS))
    return tmp_path


def complaint(capsys, *arguments) -> str:
    with pytest.raises(SystemExit) as stop:
        command.main([*map(str, arguments)])
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_what_is_missing_is_said_in_one_line(run, tmp_path, capsys):
    assert f"--models: other is not in {run / 'models'}, which has {AFTER}, {BEFORE}" in complaint(
        capsys, run, "--models", "other"
    )
    assert "--seconds must be a positive number" in complaint(capsys, run, "--seconds", "0")
    (run / "report.json").write_text("{}")
    assert "expected the folder of param_shift or external_force" in complaint(capsys, run)


@pytest.mark.slow
def test_forecasts_begin_at_the_vehicle_and_the_files_can_be_read(run, capsys):
    command.main([str(run), "--models", AFTER, "--seconds", "1", "--reference", "hover"])
    printed = capsys.readouterr().out.split()
    recording, picture = run / "replay" / "replay.rrd", run / "replay" / "replay.gif"
    assert printed[-2:] == [str(recording), str(picture)]
    verify = [sys.executable, "-m", "rerun", "rrd", "verify", str(recording)]
    assert subprocess.run(verify, capture_output=True, check=False).returncode == 0
    assert Image.open(picture).n_frames == 5  # half a second of the flight, before the last forecast


@pytest.mark.slow
def test_the_true_model_forecasts_the_flight():
    """Where the model is the vehicle, and nothing else acts, its forecast is where the vehicle goes."""
    controller = control.Controller(hj.IRIS)
    alone = Domain("source", forces=())
    reference = control.sample(command.PATHS["step"], controller, 1.0)
    flight = command._flown(hj.rigid_body(hj.IRIS), alone, reference, reference[0], controller)
    last = command.FORECAST // command.SHOWN_EVERY
    reached = flight.states[last:, :3]
    np.testing.assert_allclose(flight.forecasts[: len(reached), -1], reached, atol=1e-3)
