"""Simulated logs of a rigid body near hover; and folders of simulated flights, as several loggers write them."""

from pathlib import Path

import jax
import numpy as np
from writers import bag, blackbox, crazyflie, escs, foreign, px4_topics, table_of, ulog

from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.simulated import csv_of
from hybrid_jax import IRIS, rigid_body, rollout_batch
from hybrid_jax.flights import FlightLog
from hybrid_jax.sim import random_flights

DT, SAMPLES = 0.01, 90
CONFIG = RealFlightConfig(horizon=(5, 10), n=(20,), seeds=1)


def flights(names, seed=0):
    """Short flights near hover, of a rigid body."""
    rng = np.random.default_rng(seed)
    x0 = np.zeros((len(names), 13), np.float32)
    x0[:, 3], x0[:, 2], x0[:, 7:] = 1, 2, rng.normal(0, 0.1, (len(names), 6))
    u = IRIS.hover_speed + rng.normal(0, 5, (len(names), SAMPLES - 1, 4)).astype(np.float32)
    x = np.concatenate([x0[:, None], jax.jit(rollout_batch)(rigid_body(IRIS), x0, u, DT)], axis=1)
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


# The motors of the Crazyflie's log are 60 times their speed, of at most 65535.
READING = "--columns map.toml --topics motors=/rotors:data:rpm --polynomial 0,1092.25"


def simulated(domain, flights, seed, seconds=11.0):
    flown = random_flights(domain, flights, seconds, jax.random.key(seed))
    logs = zip(np.asarray(flown.states[:, :-1]), np.asarray(flown.inputs), strict=True)
    return [FlightLog(0.01 * np.arange(len(u)), x, u) for x, u in logs]


def written(folder, domain, flights, seed):
    """A folder of simulated flights."""
    folder.mkdir()
    for i, log in enumerate(simulated(domain, flights, seed)):
        (folder / f"flight{i}.csv.gz").write_bytes(csv_of(log.t, log.x, log.u))
    return folder


def of_every_format(folder, logs):
    """Flights as PX4, a Crazyflie, ROS, a logger with its own columns and Betaflight write them, the last as z.bbl."""
    folder.mkdir()
    px4, card, ros, own, betaflight = logs
    (folder / "px4.ulg").write_bytes(ulog(px4_topics(px4, 100) | {"esc_status": escs(px4.t, px4.u)}))
    (folder / "usd00").write_bytes(crazyflie(card))
    bag(folder / "ros", ros, "ROS1")
    (folder / "own.csv").write_text(table_of(foreign(own)))
    (folder / "z.bbl").write_bytes(blackbox(betaflight))
