"""Damaged files of every format are read or refused in one line, in seconds and little memory."""

import gzip
import os
import resource
import time

import numpy as np
import pytest
from surface import outcome
from writers import bag, blackbox, crazyflie, escs, ulog

from hybrid_jax.flights.checks.consistency import check_log
from hybrid_jax.flights.checks.suitability import check_recording, failures
from hybrid_jax.flights.conversion import to_flight
from hybrid_jax.flights.load import read_recording
from hybrid_jax.flights.log import COLUMNS
from hybrid_jax.vehicle import IRIS

NAMES = ("flight.csv", "flight.ulg", "flight.bbl", "log00", "log00.gz", "flight.bag", "flight.db3", "flight.mcap")
LIBRARY = {"flight.ulg": "pyulog", "flight.bbl": "orangebox", "flight.bag": "rosbags"}
SECONDS, MEMORY = 10.0, 1 << 20  # of one file, s; kB


@pytest.fixture(scope="module")
def wholes(flight, topics, tmp_path_factory):
    """Name → bytes of a small file of each format."""
    folder, few = tmp_path_factory.mktemp("bags"), flight[:30]
    rows = np.column_stack([few.t, few.x, few.u]).tolist()
    made = {"flight.csv": "\n".join([",".join(COLUMNS), *(",".join(map(repr, row)) for row in rows)]).encode()}
    made |= {"log00": crazyflie(few), "log00.gz": gzip.compress(crazyflie(few)), "flight.bbl": blackbox(few)}
    short = {name: samples[:60] for name, samples in topics.items()}
    made["flight.ulg"] = ulog(short | {"esc_status": escs(few.t - few.t[0], few.u)}, parameters={"MAV_TYPE": 2})
    for plugin, suffix in (("ROS1", "bag"), ("SQLITE3", "db3"), ("MCAP", "mcap")):
        path = bag(folder / suffix, few, plugin)
        made[f"flight.{suffix}"] = next(iter(path.glob(f"*.{suffix}") if path.is_dir() else [path])).read_bytes()
    return made


def mutated(content, rng):
    """A few bytes changed, cut out, doubled or made a huge number, and perhaps the end lost."""
    content = bytearray(content)
    for _ in range(rng.integers(1, 6)):
        at, size = int(rng.integers(len(content))), int(rng.integers(1, 40))
        wide = int(rng.choice([1, 2, 4, 8]))
        change = {
            "cut": lambda at=at, size=size: (at + size, b""),
            "doubled": lambda at=at, size=size: (at, content[at : at + size]),
            "flipped": lambda at=at: (at + 1, bytes([content[at] ^ int(rng.integers(1, 256))])),
            "huge": lambda at=at, wide=wide: (at + wide, rng.choice([b"\xff", b"\x7f"]) * wide),
        }
        end, other = change[str(rng.choice([*change]))]()
        content[at:end] = other
    return bytes(content[: int(rng.integers(1, len(content)))] if rng.random() < 0.2 else content)


def went_through(path):
    """Reads, checks and converts, and looks at what each says."""
    recording = outcome(
        read_recording, path, topics={} if path.name.endswith(".ulg") else {"motors": "/rotors:data:rpm"}
    )
    if recording is not None:
        assert all(np.isfinite(signal.values).all() for signal in recording.signals.values())
        assert all("\n" not in line for line in failures(check_recording(recording, IRIS, 0.01), "log"))
        log = outcome(to_flight, recording, naming=str(path))
        if log is not None and log.u.shape[1] == 4:
            check_log(log, IRIS)


@pytest.mark.parametrize("count", [40, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", NAMES)
def test_a_mutated_file_ends_in_a_log_or_a_line(tmp_path, wholes, capfd, name, count):
    """Without another exception, a hang, much memory, or a word on standard output."""
    pytest.importorskip(LIBRARY.get(name, "numpy"))
    seed = int(os.environ.get("SEED", "0"))
    rng, slowest, path = np.random.default_rng(seed), 0.0, tmp_path / name
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(count):
        path.write_bytes(mutated(wholes[name], rng))
        began = time.monotonic()
        went_through(path)
        slowest = max(slowest, time.monotonic() - began)
    assert slowest < SECONDS
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEMORY
    assert capfd.readouterr().out == ""
