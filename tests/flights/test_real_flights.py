"""Logs of real vehicles are read, or refused for what is wrong; checks agree with what is known of them."""

import os
from pathlib import Path

import numpy as np
import pytest
from writers import failures

from hybrid_jax.flights import check_recording, cut_windows
from hybrid_jax.flights.checks.consistency import OK, check_log
from hybrid_jax.flights.load import CRAZYFLIE, ULOG, find_logs, format_of, load_log, read_recording
from hybrid_jax.identification.estimates import estimate
from hybrid_jax.vehicle import load_vehicle

FOLDER = Path(os.environ.get("HYBRID_JAX_FLIGHTS", Path(__file__).parents[3] / "shared" / "flights"))
SETS = {"crazyflie_payload": ("bare", "payload"), "nanodrone": ("train", "valid")}
FILES = [f for name, parts in SETS.items() for part in parts for f in sorted((FOLDER / name / part).glob("*.csv.gz"))]


@pytest.mark.skipif(not FILES, reason="no real flights: set HYBRID_JAX_FLIGHTS to their folder")
@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.parent.name}/{file.name.split('.')[0]}")
def test_real_flights_pass_all_checks(file):
    log, vehicle = load_log(file), load_vehicle(file.parents[1] / "vehicle.toml")
    found = {check.name: check for check in check_log(log, vehicle)}
    lag = found.pop("lag of the gyro behind the motors")
    for check in found.values():
        assert check.verdict == OK, check
    # The payload set is shifted to the gyro, the nanodrone set is only good to ±1.5 samples from run to run.
    assert abs(lag.value) < (2 if file.parent.name in ("bare", "payload") else 25)
    cut = cut_windows([log], 50, 50)
    assert np.isfinite(cut.x).all()
    assert len(cut) == (len(log) - 1) // 50


RAW = Path(os.environ.get("HYBRID_JAX_LOGS", Path(__file__).parents[3] / "shared" / "logs"))
needs_logs = pytest.mark.skipif(not RAW.is_dir(), reason="no real logs: set HYBRID_JAX_LOGS to their folder")
CORNERS = [[1, -1], [-1, -1], [-1, 1], [1, 1]]  # M1 … M4: front right, rear right, rear left, front left
# PX4 log → the check that fails first, and how many rotors it has.
PX4 = {
    "sample": ("motors turn", 4),
    "sample_appended_multiple": ("motors turn", 4),
    "sample_log_small": ("airframe: VTOL (SYS_AUTOSTART 13014)", 8),
    "sample_logging_tagged_and_default_params": ("motors turn", 4),
    "sample_px4_events": ("slowest signal: slower than 100 Hz: position 10 Hz", 4),
}


@needs_logs
@pytest.mark.parametrize("name", PX4)
def test_no_public_px4_log_is_a_flight_at_100_hz(name):
    recording = read_recording(RAW / "px4" / f"{name}.ulg")
    failed, rotors = PX4[name]
    assert failures(check_recording(recording, None, 0.01), "log")[0].startswith(f"log: {failed}")
    assert (recording.facts["format"], recording.rotors) == (ULOG, rotors)


@needs_logs
def test_all_crazyflie_logs_are_whole():
    paths = [path for path in sorted(RAW.rglob("*.gz")) if format_of(path)[0] == CRAZYFLIE]
    assert paths
    for path in paths:
        recording = read_recording(path)
        assert "damage" not in recording.facts
        assert recording.rotors == 4
        assert not [line for line in failures(check_recording(recording), "log") if "quantities" not in line]
    assert set(find_logs(RAW / "sysid_tools")[1].values()) == {"not a supported format"}


@needs_logs
@pytest.mark.parametrize("name", ["sysid_tools", "crazypad/controller_data/normal_flight"])
def test_where_rotors_are_and_how_they_spin_follows_from_commands_and_gyro(name):
    found = estimate([read_recording(path) for path in find_logs(RAW / name)[0]])
    np.testing.assert_array_equal(np.sign(found.positions(1.0)), CORNERS)
    assert found.spin() == [-1, 1, -1, 1]
    if name == "sysid_tools":
        assert found.lag == pytest.approx(0.072, rel=0.15)
