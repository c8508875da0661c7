"""Logs of real vehicles are read; checks and errors of baselines agree with what is known of them."""

import os
from pathlib import Path

import numpy as np
import pytest

from hybrid_jax.dynamics.baselines import FrozenRates, HoldState
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.flights.checks.consistency import OK, check_log
from hybrid_jax.flights.load import load_log
from hybrid_jax.flights.scores import flight_errors
from hybrid_jax.flights.windows import cut_windows
from hybrid_jax.vehicle import load_vehicle

FOLDER = Path(os.environ.get("HYBRID_JAX_FLIGHTS", Path(__file__).parents[3] / "shared" / "flights"))
SETS = {"crazyflie_payload": ("bare", "payload"), "nanodrone": ("train", "valid")}
FILES = [
    file for name, parts in SETS.items() for part in parts for file in sorted((FOLDER / name / part).glob("*.csv.gz"))
]

pytestmark = pytest.mark.skipif(not FILES, reason="no real flights: set HYBRID_JAX_FLIGHTS to their folder")


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


@pytest.mark.parametrize("file", [file for file in FILES if file.parent.name == "payload"], ids=lambda file: file.name)
def test_load_changes_the_ratio_of_thrust(file):
    """Stated mass 37 g, actual mass 44.4 g: 37 / 44.4 = 0.83, with estimated thrust coefficients."""
    found = {check.name: check for check in check_log(load_log(file), load_vehicle(file.parents[1] / "vehicle.toml"))}
    assert found["specific force over thrust per mass"].value == pytest.approx(37 / 44.4, rel=0.05)


# Published for 54 others: position [m], velocity [m/s], rotation [rad], body rates [rad/s] after 0.1 s. Those here
# turn less, so of rotation and rates only the order of magnitude is the same.
HELD_OUT = {"hold": (0.0903, 0.282, 0.145, 1.534), "thrust": (0.0144, 0.0661, 0.0808, 1.534)}


@pytest.mark.parametrize("name", HELD_OUT)
def test_baseline_errors_are_close_to_published_ones(name):
    vehicle = load_vehicle(FOLDER / "crazyflie_payload" / "vehicle.toml", "payload")
    field = {"hold": HoldState(), "thrust": FrozenRates(rigid_body(vehicle, ()))}[name]
    windows = cut_windows([load_log(file) for file in FILES if file.parent.name == "payload"], 10, 10)
    found = np.sqrt([np.mean(part[:, 9] ** 2) for part in flight_errors(field, windows)])
    np.testing.assert_allclose(found[:2], HELD_OUT[name][:2], rtol=0.15)
    assert (np.abs(np.log(found / HELD_OUT[name])) < np.log(2)).all()
