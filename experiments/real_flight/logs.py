"""Folders of logs: read or simulated, checked against the vehicle, cleaned as configured, recorded for the report."""

import gzip
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.real_flight.config import Cleaning, RealFlightConfig
from hybrid_jax.flights import windows
from hybrid_jax.flights.cleaning import align_motors, delay_motors, in_flight, lag_motors, low_pass, resample
from hybrid_jax.flights.consistency import FAILS, check_log
from hybrid_jax.flights.log import COLUMNS, FlightLog, gaps, repeats, segments
from hybrid_jax.flights.windows import flight_of
from hybrid_jax.io.archive import digest
from hybrid_jax.io.files import write_atomic
from hybrid_jax.sim.domain import PARAMETER_SHIFT, SOURCE, Domain
from hybrid_jax.sim.flight import DT, fly, gone_wrong
from hybrid_jax.vehicle import IRIS, Vehicle

# Of --simulated: the domains and the numbers of flights.
FLIGHTS = {"source": (SOURCE, 10), "target": (PARAMETER_SHIFT, 6)}
SECONDS = 8.0


@dataclass(frozen=True)
class LogSet:
    """The flights of one folder."""

    label: str  # source, target or test
    logs: list[FlightLog]  # after cleaning
    records: list[dict[str, Any]]  # of each flight, as JSON values: see `_record`

    def with_lag(self, time_constant: float) -> "LogSet":
        """The flights with rotors that follow the log's motor values with a first-order lag [s]."""
        logs, lines = zip(*(lag_motors(log, time_constant) for log in self.logs), strict=True)
        records = [each | {"done": [*each["done"], line]} for each, line in zip(self.records, lines, strict=True)]
        return LogSet(self.label, list(logs), records)


def load_logs(option: str, folder: Path, vehicle: Vehicle, time_constant: float, config: RealFlightConfig) -> LogSet:
    """Read, check and clean all logs of a folder, which the given option named; rotors lag by the time constant [s]."""
    try:
        found = windows.load_logs(folder, columns=config.columns, polynomial=config.polynomial)
    except ValueError as error:
        about_folder = str(error).startswith(f"{folder}: ")
        raise ValueError(f"--{option} {error}" if about_folder else str(error)) from error
    cleaned = [clean(raw, config.cleaning, vehicle) for raw in found]
    records = [_record(option, raw, *each, vehicle) for raw, each in zip(found, cleaned, strict=True)]
    logs = LogSet(option, [log for log, _ in cleaned], records)
    return logs.with_lag(time_constant) if time_constant else logs


def require_distinct(sets: Sequence[LogSet], config: RealFlightConfig) -> None:
    """Refuse a flight that occurs twice, whatever its files are called: it could be in training and test.

    Source and test may share flights where each is tested by models trained on other manoeuvres.
    """
    shared = config.target is None and config.folds_by == "manoeuvre"
    first: dict[tuple[str, str], str] = {}
    for each in sets:
        for log, record in zip(each.logs, each.records, strict=True):
            key, file = (each.label if shared else "", record["sha256"]), f"--{each.label} {log.name}"
            if key in first:
                raise ValueError(f"{file}: the same flight as {first[key]}; leave one of the two out")
            first[key] = file


def clean(log: FlightLog, cleaning: Cleaning, vehicle: Vehicle) -> tuple[FlightLog, list[str]]:
    """Apply the configured changes to a log; also return one line per change."""
    steps: dict[str, tuple[Any, Callable[[FlightLog, Any], tuple[FlightLog, str]]]] = {
        "in-flight": (cleaning.in_flight or None, lambda log, _: in_flight(log)),
        "resample": (cleaning.resample, lambda log, dt: resample(log, dt, cleaning.longest_gap)),
        "low-pass": (cleaning.low_pass, low_pass),
        "align": (cleaning.align or None, lambda log, _: align_motors(log, vehicle)),
        "delay": (cleaning.delay or None, delay_motors),
    }
    done: list[str] = []
    for option, (value, change) in steps.items():
        if value is None:
            continue
        try:
            log, line = change(log, value)
        except ValueError as error:
            why = str(error).removeprefix(f"{log.name}: ")
            raise ValueError(f"{log.name}: --cleaning.{option}: {why}") from error
        done.append(line)
    return log, done


def _record(folder: str, raw: FlightLog, log: FlightLog, done: list[str], vehicle: Vehicle) -> dict[str, Any]:
    checks = [asdict(check) for check in check_log(raw, vehicle)]
    return {
        "folder": folder,
        "flight": flight_of(raw),
        "sha256": digest(None, {"t": raw.t, "x": raw.x, "u": raw.u}),
        "samples": len(raw),
        "seconds": round(float(raw.t[-1] - raw.t[0]), 3),
        "dt": raw.dt,
        "gaps": int(gaps(raw).sum()),
        "repeated_samples": int(repeats(raw).sum()),
        "used_samples": sum(part.stop - part.start for part in segments(log)),
        "done": done,
        "fails": sum(check["verdict"] == FAILS for check in checks),
        "checks": checks,
    }


def write_logs(folder: Path, seed: int) -> tuple[Path, dict[str, Path]]:
    """Simulate flights before and after a change of the inertia; return the vehicle file, and the folders by name."""
    vehicle = folder / "vehicle.toml"
    write_atomic(vehicle, vehicle_toml(IRIS))
    for name, (domain, count) in FLIGHTS.items():
        for index, content in enumerate(_flights(domain, count, seed)):
            write_atomic(folder / name / f"flight_{index:02d}.csv.gz", content)
    return vehicle, {name: folder / name for name in FLIGHTS}


def vehicle_toml(vehicle: Vehicle) -> str:
    """The text of a vehicle file; the numbers, names and lists of JSON are those of TOML as well."""
    return "[vehicle]\n" + "".join(f"{name} = {json.dumps(value)}\n" for name, value in asdict(vehicle).items())


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
