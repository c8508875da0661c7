"""Logs of simulated flights in the library's CSV format, to try the experiment without logs of one's own."""

import gzip
import io
from dataclasses import asdict
from pathlib import Path

import jax
import numpy as np

from hybrid_jax.flights.log import COLUMNS
from hybrid_jax.io.files import write_atomic
from hybrid_jax.sim.domain import PARAMETER_SHIFT, SOURCE, Domain
from hybrid_jax.sim.flight import DT, fly, gone_wrong
from hybrid_jax.vehicle import IRIS, Vehicle

FLIGHTS = {"source": (SOURCE, 10), "target": (PARAMETER_SHIFT, 6)}
SECONDS = 8.0


def write_logs(folder: Path, seed: int) -> tuple[Path, dict[str, Path]]:
    """Simulate flights before and after a change of the inertia; return the vehicle file, and the folders by name."""
    vehicle = folder / "vehicle.toml"
    write_atomic(vehicle, vehicle_toml(IRIS))
    for name, (domain, count) in FLIGHTS.items():
        for index, content in enumerate(_flights(domain, count, seed)):
            write_atomic(folder / name / f"flight_{index:02d}.csv.gz", content)
    return vehicle, {name: folder / name for name in FLIGHTS}


def vehicle_toml(vehicle: Vehicle) -> str:
    """The text of a vehicle file."""

    def text(value) -> str:
        if isinstance(value, tuple):
            return f"[{', '.join(map(text, value))}]"
        return f'"{value}"' if isinstance(value, str) else repr(value)

    return "[vehicle]\n" + "".join(f"{name} = {text(value)}\n" for name, value in asdict(vehicle).items())


def csv_of(t: np.ndarray, x: np.ndarray, u: np.ndarray) -> bytes:
    """A log as CSV in gzip; the same numbers give the same bytes."""
    text = io.StringIO()
    np.savetxt(text, np.column_stack([t, x, u]), "%.9g", ",", header=",".join(COLUMNS), comments="")
    return gzip.compress(text.getvalue().encode(), mtime=0)


def _flights(domain: Domain, count: int, seed: int) -> list[bytes]:
    # Flights that fail are left out, so more are simulated; a chunk of them is simulated in any case.
    found = fly(domain, 2 * count, SECONDS, jax.random.key(seed))
    sound = np.flatnonzero(~gone_wrong(found.states))[:count]
    states, inputs = np.asarray(found.states), np.asarray(found.inputs)
    times = DT * np.arange(states.shape[1])
    # Each sample of a log holds the inputs of the interval that follows it; the last inputs are repeated.
    return [csv_of(times, states[i], inputs[i][[*range(len(times) - 1), -1]]) for i in sound]
