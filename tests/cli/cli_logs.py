"""Folders of simulated flights, as several loggers write them."""

import jax
import numpy as np
from writers import bag, blackbox, crazyflie, escs, foreign, px4_topics, table_of, ulog

from experiments.real_flight.simulated import csv_of
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.sim import random_flights

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
