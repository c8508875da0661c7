"""Logs of real vehicles are read, and the checks agree with what is known of them."""

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest

from hybrid_jax.flights.consistency import OK, check_log
from hybrid_jax.flights.flight_csv import read_csv
from hybrid_jax.flights.windows import cut_windows
from hybrid_jax.vehicle import Vehicle

FOLDER = Path(os.environ.get("HYBRID_JAX_FLIGHTS", Path(__file__).parents[3] / "shared" / "flights"))
SETS = {"crazyflie_payload": ("bare", "payload"), "nanodrone": ("train", "valid")}
FILES = [
    file for name, parts in SETS.items() for part in parts for file in sorted((FOLDER / name / part).glob("*.csv.gz"))
]

pytestmark = pytest.mark.skipif(not FILES, reason="no real flights: set HYBRID_JAX_FLIGHTS to their folder")


def vehicle_of(file):
    table = tomllib.loads((file.parents[1] / "vehicle.toml").read_text())["vehicle"]
    table.pop("payload", None)
    table["rotor_positions"] = tuple(map(tuple, table["rotor_positions"]))
    return Vehicle(**table | {key: tuple(table[key]) for key in ("inertia", "spin")})


@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.parent.name}/{file.name.split('.')[0]}")
def test_real_flights_pass_all_checks(file):
    log, vehicle = read_csv(file), vehicle_of(file)
    found = {check.name: check for check in check_log(log, vehicle)}
    lag = found.pop("lag of the gyro behind the motors")
    for check in found.values():
        assert check.verdict == OK, check
    # The payload set is shifted to the gyro, the nanodrone set is only good to ±1.5 samples from run to run.
    assert abs(lag.value) < (2 if file.parent.name in ("bare", "payload") else 25)
    cut = cut_windows([log], 50, 50).windows
    assert np.isfinite(cut.x).all()
    assert len(cut) == (len(log) - 1) // 50


@pytest.mark.parametrize("file", [file for file in FILES if file.parent.name == "payload"], ids=lambda file: file.name)
def test_load_changes_the_ratio_of_thrust(file):
    """Stated mass 37 g, actual mass 44.4 g: 37 / 44.4 = 0.83, with estimated thrust coefficients."""
    found = {check.name: check for check in check_log(read_csv(file), vehicle_of(file))}
    assert found["specific force over thrust per mass"].value == pytest.approx(37 / 44.4, rel=0.05)
