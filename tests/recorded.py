"""Simulated logs of a rigid body near hover, and a configuration for which they suffice."""

from pathlib import Path

import jax
import numpy as np

import hybrid_jax
from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.simulated import csv_of
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.vehicle import IRIS

DT, SAMPLES = 0.01, 90
CONFIG = RealFlightConfig(horizon=(5, 10), n=(20,), seeds=1)


@jax.jit
def _flown(x0, u):
    return rollout_batch(hybrid_jax.rigid_body(IRIS), x0, u, DT)


def flights(names, seed=0):
    """Short flights near hover, of a rigid body."""
    rng = np.random.default_rng(seed)
    x0 = np.zeros((len(names), 13), np.float32)
    x0[:, 3], x0[:, 2], x0[:, 7:] = 1, 2, rng.normal(0, 0.1, (len(names), 6))
    u = IRIS.hover_speed + rng.normal(0, 5, (len(names), SAMPLES - 1, 4)).astype(np.float32)
    x = np.concatenate([x0[:, None], _flown(x0, u)], axis=1)
    u = np.concatenate([u, u[:, -1:]], axis=1)
    return [FlightLog(DT * np.arange(SAMPLES), *both, name) for *both, name in zip(x, u, names, strict=True)]


LOGS = flights([f"/logs/{kind}_run{i}.csv" for kind in ("chirp", "random", "square") for i in (1, 2, 3)])
OTHERS = flights([f"/more/{kind}_run4.csv" for kind in ("chirp", "random", "square", "melon")], seed=1)


def write(folder, logs):
    """The logs as files of a folder, gzipped; the folder."""
    for log in logs:
        path = folder / Path(log.name).name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_name(f"{path.name}.gz").write_bytes(csv_of(log.t, log.x, log.u))
    return folder
