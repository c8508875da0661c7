"""A folder of logs becomes windows in one call, or is refused in one line."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import DT, LOGS, SAMPLES, write
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.flights import FlightLog
from hybrid_jax.vehicle import IRIS


def test_windows_are_those_of_all_logs(tmp_path, recwarn):
    write(tmp_path, LOGS[:2])
    windows = hj.load_windows(tmp_path, IRIS, steps=20, stride=5)
    assert (windows.dt, windows.horizon, len(windows)) == (DT, 20, 2 * len(range(0, SAMPLES - 20, 5)))
    assert windows.x.dtype == np.float32
    np.testing.assert_allclose(windows.x[0], LOGS[0].x[1:21], atol=1e-5)
    assert all("\n" not in str(each.message) for each in recwarn)


@pytest.mark.filterwarnings("ignore")
def test_logs_are_resampled_to_dt_and_rotors_may_lag(tmp_path):
    write(tmp_path, [LOGS[0], replace(LOGS[1], t=2 * LOGS[1].t)])
    refusal(lambda: hj.load_windows(tmp_path, IRIS, failed="warn"), "0.02 s apart", "dt=0.02")
    windows = hj.load_windows(tmp_path, IRIS, dt=0.02, motor_time_constant=0.05, failed="warn")
    assert windows.dt == 0.02
    assert windows.u.std() < hj.load_windows(tmp_path, IRIS, dt=0.02, failed="warn").u.std()


def test_failed_checks_are_reported(tmp_path):
    still = FlightLog(LOGS[0].t, LOGS[0].x, LOGS[0].u * [1, 1, 1, 0], "still.csv")
    write(tmp_path, [still])
    with pytest.warns(UserWarning, match=r"still.csv.gz: columns: u3 never changes"):
        hj.load_windows(tmp_path, IRIS, failed="warn")
    refusal(lambda: hj.load_windows(tmp_path, IRIS), "still.csv.gz: ", 'failed="warn" goes on')
    refusal(lambda: hj.load_windows(tmp_path, IRIS, failed="no"), "failed must be")


@pytest.mark.parametrize(
    ("options", "message"),
    [({"steps": 0}, "steps"), ({"dt": -1.0}, "dt must be"), ({"steps": 500}, "no window of 500")],
)
def test_invalid_arguments_are_refused(tmp_path, options, message):
    write(tmp_path, LOGS[:1])
    refusal(lambda: hj.load_windows(tmp_path, IRIS, **options), message)
    refusal(lambda: hj.load_windows(tmp_path / "none", IRIS), "no such folder")
