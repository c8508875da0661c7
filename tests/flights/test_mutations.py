"""Damaged files of every kind are read or refused in one line, in seconds and little memory."""

import gzip
import os
import resource
import time

import equinox as eqx
import jax
import numpy as np
import pytest
from surface import outcome, refusal
from writers import bag, blackbox, crazyflie, escs, failures, ulog

import hybrid_jax as hj
from experiments.real_flight.simulated import vehicle_toml
from experiments.runner.run_record import record_in
from hybrid_jax.dynamics.vehicle_file import load_vehicle_model
from hybrid_jax.export import Program, export_program, load_program
from hybrid_jax.flights import check_log, check_recording, read_recording, to_flight
from hybrid_jax.flights.log import COLUMNS
from hybrid_jax.io.datasets import Dataset, load_dataset, save_dataset
from hybrid_jax.io.files import json_text, named_leaves, save_archive, write_atomic
from hybrid_jax.io.models import FORMAT as MODEL

LOGS = ("flight.csv", "flight.ulg", "flight.bbl", "log00", "log00.gz", "flight.bag", "flight.db3", "flight.mcap")
LOADERS = {"model.npz": hj.load, "set.npz": load_dataset, "program.npz": load_program}
LOADERS |= {"vehicle.toml": load_vehicle_model, "run.json": record_in}
LIBRARY = {"flight.ulg": "pyulog", "flight.bbl": "orangebox", "flight.bag": "rosbags"}
SECONDS, MEMORY = 10.0, 1 << 20  # of one file, s; kB
COUNTS = pytest.mark.parametrize("count", [40, pytest.param(1000, marks=pytest.mark.slow)])


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
    model = hj.Hybrid(hj.rigid_body(hj.IRIS), hj.residual_network(13, 4, jax.random.key(0), hidden=4))
    hj.save(folder / "model.npz", model)
    export_program(folder / "program.npz", model, state_size=13, input_size=4)
    windows = hj.Trajectories(few.x[:1], few.u[None, :5], few.x[None, 1:6], 0.01)
    save_dataset(folder / "set.npz", Dataset({"train": windows}, {"config": {"vehicle": "iris"}}))
    parts = {"config": {"seeds": 3}, "versions": {}, "flights": {}, "machine": {"cores": 2}}
    write_atomic(folder / "run.json", json_text(parts | {"state": "unfinished", "started": "2026-11-28"}))
    write_atomic(folder / "vehicle.toml", vehicle_toml(hj.IRIS))
    return made | {name: (folder / name).read_bytes() for name in LOADERS}


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


def content(found):
    if isinstance(found, Program):
        return np.asarray(found(np.eye(13)[3], np.full(4, 600.0)))
    return named_leaves(found.field if isinstance(found, hj.Model) else dict(found.splits))


def went_through(path, whole):
    """Reads, checks and converts, and looks at what each says; an archive is whole or refused."""
    if path.name in LOADERS:
        found = outcome(LOADERS[path.name], path, naming=str(path))
        if found is not None and path.suffix == ".npz":
            path.write_bytes(whole)
            assert eqx.tree_equal(content(found), content(LOADERS[path.name](path)))
        return
    topics = {} if path.name.endswith(".ulg") else {"motors": "/rotors:data:rpm"}
    recording = outcome(read_recording, path, topics=topics)
    if recording is not None:
        assert all(np.isfinite(signal.values).all() for signal in recording.signals.values())
        assert all("\n" not in line for line in failures(check_recording(recording, hj.IRIS, 0.01), "log"))
        log = outcome(to_flight, recording, naming=str(path))
        if log is not None and log.u.shape[1] == 4:
            check_log(log, hj.IRIS)


@COUNTS
@pytest.mark.parametrize("name", [*LOGS, *LOADERS])
def test_a_mutated_file_is_read_or_ends_in_a_line(tmp_path, wholes, capfd, name, count):
    """Without another exception, a hang, much memory, or a word on standard output."""
    pytest.importorskip(LIBRARY.get(name, "numpy"))
    slowest, path, rng = 0.0, tmp_path / name, np.random.default_rng(int(os.environ.get("SEED", "0")))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(count):
        path.write_bytes(mutated(wholes[name], rng))
        began = time.monotonic()
        went_through(path, wholes[name])
        slowest = max(slowest, time.monotonic() - began)
    assert slowest < SECONDS
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEMORY
    assert capfd.readouterr().out == ""


def test_what_is_said_of_a_file_is_short(tmp_path):
    for number, tree in enumerate(({"class": "x" * 200_000, "fields": {}}, {"named": "y" * 200_000})):
        save_archive(tmp_path / f"{number}.npz", MODEL, {"field": tree, "about": {}}, {})
        assert len(refusal(lambda number=number: hj.load(tmp_path / f"{number}.npz"))) < 500
