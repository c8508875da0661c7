"""Errors of simple baselines on real flights are close to those published for other flights of the set."""

import os
from pathlib import Path

import numpy as np
import pytest

from hybrid_jax.dynamics.baselines import FrozenRates, HoldState
from hybrid_jax.dynamics.multirotor import multirotor
from hybrid_jax.flights.flight_csv import read_csv
from hybrid_jax.flights.scores import flight_errors
from hybrid_jax.flights.windows import cut_windows
from hybrid_jax.vehicle import load_vehicle

FOLDER = Path(os.environ.get("HYBRID_JAX_FLIGHTS", Path(__file__).parents[3] / "shared" / "flights"))
PAYLOAD = FOLDER / "crazyflie_payload"
FILES = sorted((PAYLOAD / "payload").glob("*.csv.gz"))

pytestmark = pytest.mark.skipif(not FILES, reason="no real flights: set HYBRID_JAX_FLIGHTS to their folder")


@pytest.fixture(scope="module")
def flights():
    return cut_windows([read_csv(file) for file in FILES], 10, 10).windows


# Published for 54 others: position [m], velocity [m/s], rotation [rad], body rates [rad/s] after 0.1 s. Those here
# turn less, so of rotation and rates only the order of magnitude is the same.
HELD_OUT = {"hold": (0.0903, 0.282, 0.145, 1.534), "thrust": (0.0144, 0.0661, 0.0808, 1.534)}


@pytest.mark.parametrize("name", HELD_OUT)
def test_baseline_errors_are_close_to_published_ones(flights, name):
    vehicle = load_vehicle(PAYLOAD / "vehicle.toml", "payload")
    field = {"hold": HoldState(), "thrust": FrozenRates(multirotor(vehicle, ()))}[name]
    found = np.sqrt([np.mean(part[:, 9] ** 2) for part in flight_errors(field, flights)])
    np.testing.assert_allclose(found[:2], HELD_OUT[name][:2], rtol=0.15)
    assert (np.abs(np.log(found / HELD_OUT[name])) < np.log(2)).all()
