"""Weak scaling: as many lanes for each device, on more devices and in more processes. Does an epoch take as long?

A sweep of hybrids in processes of its own: one device held to one core, one that may use all, all cores as devices
of one process, and as many processes of one device. Timed are epochs between two blocks, exchanges and the host's loop
included; imports, joining and compiling are apart. All places take turns; after the first, programs come from a cache.
"""

import json
import os
import socket
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.timing import Findings, Ratio, run, run_together, table
from hybrid_jax.runtime import configure, cores

REACH = 1.8 / 2  # of each further device: what a second core is to add


@dataclass(frozen=True)
class Place:
    """Where lanes run: processes, devices of each, and whether a process is held to one core."""

    processes: int
    devices: int
    held: bool = False

    def __str__(self) -> str:
        return f"{self.processes} × {self.devices}{', held to one core' if self.held else ''}"


@dataclass(frozen=True)
class Preset:
    """Lanes for each device, training windows of each, epochs that are timed, at the least, and turns."""

    lanes: int
    windows: int
    epochs: int
    turns: int


PRESETS = {
    "full": Preset(lanes=4, windows=1000, epochs=20, turns=10),
    "smoke": Preset(lanes=1, windows=100, epochs=4, turns=1),
}

# Runs in each process, its part as JSON in the one argument; process 0 prints what it saw.
PROCESS = "import sys; from benchmarks.scaling import take_part; take_part(sys.argv[1])"


def take_part(order: str) -> None:
    """Be one of the processes of a place: train, and as process 0 print the seconds as JSON."""
    began = time.perf_counter()
    part = json.loads(order)
    place, preset = Place(**part["place"]), Preset(**part["preset"])
    if place.held:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    import jax

    from hybrid_jax.sweep import hosts

    configure(Path(part["cache"]))
    jax.config.update("jax_num_cpu_devices", place.devices)
    imported = time.perf_counter()
    if place.processes > 1:
        hosts.initialize(part["address"], place.processes, part["process"])
    joined = time.perf_counter()
    seconds, first = timed_epochs(place, preset)
    if hosts.is_main_process():
        apart = {"imports": imported - began, "joining": joined - imported, "first_block": first}
        print(json.dumps({"epoch": seconds, **apart}))


def timed_epochs(place: Place, preset: Preset) -> tuple[float, float]:
    """The seconds of an epoch of all lanes, and until the first block was there."""
    from benchmarks.subjects import SETTINGS, make_windows, training_runs
    from hybrid_jax.sweep.training import sweep

    lanes = preset.lanes * place.processes * place.devices
    marks: list[tuple[int, float]] = []
    began = time.perf_counter()

    def mark(states, progress) -> None:
        marks.append((progress.epochs, time.perf_counter()))

    states, plans = training_runs("hybrid", lanes, preset.windows, max_epochs=5 + 2 * preset.epochs)
    windows = make_windows(preset.windows, 10)
    sweep(states, plans, windows, windows, SETTINGS, on_block=mark, block_seconds=1.0)
    (first, start), (last, end) = marks[0], marks[-1]
    return (end - start) / (last - first), start - began


def seconds_at(place: Place, preset: Preset, cache: str) -> dict[str, float]:
    """The seconds that process 0 of a place measured."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    shared = {"place": asdict(place), "preset": asdict(preset), "address": address, "cache": cache}
    orders = [json.dumps(shared | {"process": i}) for i in range(place.processes)]
    return json.loads(run_together(str(place), [["-c", PROCESS, order] for order in orders])[0].splitlines()[-1])


def places() -> list[Place]:
    """Those that this machine has cores for; only Linux can hold a process to one."""
    held = [Place(1, 1, held=True)] if hasattr(os, "sched_setaffinity") else []
    many = [Place(1, cores()), Place(cores(), 1)] if cores() > 1 else []
    return [*held, Place(1, 1), *many]


def row_of(place: Place, seen: Sequence[dict[str, float]], preset: Preset) -> dict[str, Any]:
    medians = {name: statistics.median(one[name] for one in seen) for name in seen[0]}
    medians["compiled_first_block"] = seen[0]["first_block"]  # the others find its programs
    lanes = preset.lanes * place.processes * place.devices
    return {"place": str(place), **asdict(place), "lanes": lanes, "windows": preset.windows, "seconds": medians}


COLUMNS = {
    "processes × devices": lambda row: row["place"],
    "lanes": lambda row: str(row["lanes"]),
    "epoch of all [ms]": lambda row: f"{1e3 * row['seconds']['epoch']:.1f}",
    "imports [s]": lambda row: f"{row['seconds']['imports']:.1f}",
    "joining [s]": lambda row: f"{row['seconds']['joining']:.1f}",
    "first block [s]": lambda row: f"{row['seconds']['first_block']:.1f}",
    "compiled [s]": lambda row: f"{row['seconds']['compiled_first_block']:.1f}",
}


def measure(preset: Preset) -> Findings:
    """Every place, in turns."""
    seen: dict[Place, list[dict[str, float]]] = {place: [] for place in places()}
    with TemporaryDirectory() as cache:
        for _ in range(preset.turns):
            for place, found in seen.items():
                found.append(seconds_at(place, preset, cache))
    rows = [row_of(place, found, preset) for place, found in seen.items()]
    alone, ratios = rows[0], []
    for row in rows:
        if (more := row["lanes"] / alone["lanes"]) > 1:
            # How many times the lanes of one device a place trains in the same time.
            value = more * alone["seconds"]["epoch"] / row["seconds"]["epoch"]
            ratios.append(
                Ratio(f"lanes of {row['place']} over those of {alone['place']}", value, at_least=REACH * more)
            )
    return Findings(rows, [table("weak scaling", rows, COLUMNS)], ratios)


if __name__ == "__main__":
    run("scaling", __doc__, PRESETS, measure)
