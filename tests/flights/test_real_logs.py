"""Logs as they come from real vehicles and autopilots are read, or refused for what is wrong with them."""

import os
from pathlib import Path

import numpy as np
import pytest

from hybrid_jax.cli.estimates import estimate
from hybrid_jax.flights.checks.suitability import check_recording, failures
from hybrid_jax.flights.conversion import to_flight
from hybrid_jax.flights.load import CRAZYFLIE, ULOG, find_logs, format_of, read_recording

FOLDER = Path(os.environ.get("HYBRID_JAX_LOGS", Path(__file__).parents[3] / "shared" / "logs"))
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="no real logs: set HYBRID_JAX_LOGS to their folder")
CORNERS = [[1, -1], [-1, -1], [-1, 1], [1, 1]]  # M1 … M4: front right, rear right, rear left, front left
# PX4 log → the check that fails first, and how many rotors it has.
PX4 = {
    "sample": ("motors turn", 4),
    "sample_appended_multiple": ("motors turn", 4),
    "sample_log_small": ("airframe: VTOL (SYS_AUTOSTART 13014)", 8),
    "sample_logging_tagged_and_default_params": ("motors turn", 4),
    "sample_px4_events": ("slowest signal: slower than 100 Hz: position 10 Hz", 4),
}


@pytest.mark.parametrize("name", PX4)
def test_no_public_px4_log_is_a_flight_at_100_hz(name):
    recording = read_recording(FOLDER / "px4" / f"{name}.ulg")
    failed, rotors = PX4[name]
    assert failures(check_recording(recording, None, 0.01), "log")[0].startswith(f"log: {failed}")
    assert (recording.facts["format"], recording.rotors) == (ULOG, rotors)


def test_the_flight_to_two_metres_is_one_at_ten_hz():
    recording = read_recording(FOLDER / "px4" / "sample_px4_events.ulg")
    assert not failures(check_recording(recording, None, 0.1), "log")
    log = to_flight(recording, 0.1, (0.0, 600.0))
    assert 1.9 < log.x[:, 2].max() < 2.3
    assert abs(log.dt - 0.1) < 1e-6


def test_all_crazyflie_logs_are_whole():
    paths = [path for path in sorted(FOLDER.rglob("*.gz")) if format_of(path)[0] == CRAZYFLIE]
    assert paths
    for path in paths:
        recording = read_recording(path)
        assert "damage" not in recording.facts
        assert recording.rotors == 4
        assert not [line for line in failures(check_recording(recording), "log") if "quantities" not in line]
    assert set(find_logs(FOLDER / "sysid_tools")[1].values()) == {"no format that is read"}


@pytest.mark.parametrize("name", ["sysid_tools", "crazypad/controller_data/normal_flight"])
def test_where_rotors_are_and_how_they_spin_follows_from_commands_and_gyro(name):
    found = estimate([read_recording(path) for path in find_logs(FOLDER / name)[0]])
    np.testing.assert_array_equal(np.sign(found.positions(1.0)), CORNERS)
    assert found.spin() == [-1, 1, -1, 1]
    if name == "sysid_tools":
        assert found.lag == pytest.approx(0.072, rel=0.15)
