"""Simulated flights as logs, and their vehicle file, for `--simulated`."""

import gzip
import io
import json
from dataclasses import asdict
from pathlib import Path

import jax
import numpy as np

from hybrid_jax.flights.log import COLUMNS
from hybrid_jax.io.files import write_atomic
from hybrid_jax.sim.domain import PARAMETER_SHIFT, SOURCE
from hybrid_jax.sim.flight import DT, gone_wrong, random_flights
from hybrid_jax.vehicle import IRIS, Vehicle

FLIGHTS = {"source": (SOURCE, 10), "target": (PARAMETER_SHIFT, 6)}  # domains, numbers of flights
SECONDS = 8.0


def write_logs(folder: Path, seed: int) -> tuple[Path, dict[str, Path]]:
    """Simulate flights before and after a change of the inertia; return the vehicle file, and the folders by name."""
    vehicle = folder / "vehicle.toml"
    write_atomic(vehicle, vehicle_toml(IRIS))
    for name, (domain, count) in FLIGHTS.items():
        # Flights that fail are left out, so more are simulated; a chunk of them is simulated in any case.
        found = random_flights(domain, 2 * count, SECONDS, jax.random.key(seed))
        times = DT * np.arange(found.states.shape[1])
        held = [*range(len(times) - 1), -1]  # a sample holds the inputs of the interval after it; the last are repeated
        for index, i in enumerate(np.flatnonzero(~gone_wrong(found.states))[:count]):
            content = csv_of(times, np.asarray(found.states[i]), np.asarray(found.inputs[i])[held])
            write_atomic(folder / name / f"flight_{index:02d}.csv.gz", content)
    return vehicle, {name: folder / name for name in FLIGHTS}


def vehicle_toml(vehicle: Vehicle) -> str:
    """Return the text of a vehicle file; the numbers, names and lists of JSON are also valid TOML."""
    return "[vehicle]\n" + "".join(f"{name} = {json.dumps(value)}\n" for name, value in asdict(vehicle).items())


def csv_of(t: np.ndarray, x: np.ndarray, u: np.ndarray) -> bytes:
    """Return a log as CSV in gzip; the same numbers give the same bytes."""
    text = io.StringIO()
    np.savetxt(text, np.column_stack([t, x, u]), "%.9g", ",", header=",".join(COLUMNS), comments="")
    return gzip.compress(text.getvalue().encode(), mtime=0)
