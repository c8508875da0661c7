"""How fast is a flight log read, with all its checks, beside `numpy.loadtxt` on the same file?

The log is a CSV of one flight whose numbers have nine digits. Both programs must return the same numbers and are timed
in turns. `read_csv` also finds the columns by name, counts the fields of a row, and refuses what cannot be a flight.
A million rows are then read once, and the memory that this takes is traced in a pass of its own.
smoke: a thousand rows. full: a hundred thousand in turns and a million once, about forty seconds.
"""

import tracemalloc
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.subjects import DT
from benchmarks.timing import Findings, Ratio, agree, in_turns, run, stopwatch
from hybrid_jax.flights.formats.csv import read_csv
from hybrid_jax.flights.log import COLUMNS, FlightLog
from hybrid_jax.vehicle import IRIS

REACH = 10.0  # s for a million rows
AGREEMENT = 1e-9  # relative to the fastest rotor; a log's quaternions are of norm 1, a file's only to its digits
MILLION = 1_000_000


@dataclass(frozen=True)
class Preset:
    """Rows of the log that is read in turns and of the one that is read once, and turns."""

    rows: int
    most: int
    turns: int


PRESETS = {"full": Preset(100_000, MILLION, turns=10), "smoke": Preset(1000, 2000, turns=2)}


def write_flight(path: Path, rows: int) -> None:
    """A log of a vehicle that swings about a point and about its vertical axis."""
    t = DT * np.arange(rows)
    yaw, rate = np.sin(0.7 * t), 0.7 * np.cos(0.7 * t)
    none = np.zeros_like(t)
    p, v = np.sin(np.outer(t, [0.3, 0.4, 0.5])), [0.3, 0.4, 0.5] * np.cos(np.outer(t, [0.3, 0.4, 0.5]))
    u = IRIS.hover_speed * np.random.default_rng(0).uniform(0.95, 1.05, (rows, 4))
    table = np.column_stack([t, p, np.cos(yaw / 2), none, none, np.sin(yaw / 2), v, none, none, rate, u])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=",".join(COLUMNS), comments="")


def numbers_of(log: FlightLog) -> np.ndarray:
    return np.column_stack([log.t, log.x, log.u])


def measure_both(path: Path, preset: Preset) -> dict[str, Any]:
    """Agreement and rows per second of both."""
    calls = {"read_csv": lambda: read_csv(path), "loadtxt": lambda: np.loadtxt(path, delimiter=",", skiprows=1)}
    difference = agree("numbers", numbers_of(calls["read_csv"]()), calls["loadtxt"](), AGREEMENT)
    times = in_turns(calls, preset.turns)
    return {
        "rows": preset.rows,
        "difference": difference,
        "rows_per_second": {name: preset.rows / taken for name, taken in times.medians().items()},
        "times_loadtxt": times.ratio("read_csv", "loadtxt"),
    }


def measure_once(path: Path, rows: int) -> dict[str, Any]:
    """Seconds of one pass; bytes of the numbers read, and the most that another pass held at once."""
    log, seconds = stopwatch(lambda: read_csv(path))
    kept = numbers_of(log).nbytes
    del log
    tracemalloc.start()
    read_csv(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {"rows": rows, "seconds": seconds, "bytes": kept, "peak_bytes": peak}


def measure(preset: Preset) -> Findings:
    """Both in turns, then the long log once."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "flight.csv"
        write_flight(path, preset.rows)
        both = measure_both(path, preset)
        write_flight(path, preset.most)
        once = measure_once(path, preset.most)
    made = Table("rows", "rows/s", "× loadtxt", "peak [MiB]", "numbers [MiB]", title="a CSV log is read and checked")
    speed = both["rows_per_second"]["read_csv"]
    made.add_row(f"{both['rows']:,}", f"{speed:,.0f}", f"{both['times_loadtxt']:.2f}", "", "")
    memory = (f"{once[name] / 2**20:.0f}" for name in ("peak_bytes", "bytes"))
    made.add_row(f"{once['rows']:,}", f"{once['rows'] / once['seconds']:,.0f}", "", *memory)
    million = once["seconds"] * MILLION / once["rows"]
    ratios = [
        Ratio("read_csv / loadtxt", both["times_loadtxt"]),
        Ratio(f"seconds a million rows, from {once['rows']:,}", million, at_most=REACH),
    ]
    return Findings([both, once], [made], ratios)


if __name__ == "__main__":
    run("ingest", __doc__, PRESETS, measure)
