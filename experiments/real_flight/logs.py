"""Folders of logs: read or simulated, checked against the vehicle, cleaned and recorded."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from experiments.real_flight.config import RealFlightConfig
from hybrid_jax.cli import log_options
from hybrid_jax.cli.command import ChecksFailed
from hybrid_jax.cli.flags import in_flags
from hybrid_jax.flights.checks.cleaning import clean, lag_motors
from hybrid_jax.flights.checks.consistency import FAILS, Check, check_log
from hybrid_jax.flights.checks.suitability import check_recording, failures
from hybrid_jax.flights.conversion import flight_at, own_interval
from hybrid_jax.flights.load import read_folder
from hybrid_jax.flights.log import FlightLog, gaps, repeats, segments
from hybrid_jax.flights.windows import flight_of
from hybrid_jax.io.archive import digest
from hybrid_jax.vehicle import Vehicle

MEND = "nothing was trained; mend the logs as the lines above say, or go on with --anyway"


@dataclass(frozen=True)
class LogSet:
    """The flights of one folder."""

    label: str  # source, target or test
    logs: list[FlightLog]  # after cleaning
    records: list[dict[str, Any]]  # of each flight, as JSON values: see `_record`
    left: Mapping[str, str] = field(default_factory=dict)  # other files of the folder, and why they were not read

    def with_lag(self, time_constant: float) -> "LogSet":
        """The flights with rotors that follow the log's motor values with a first-order lag [s]."""
        logs, lines = zip(*(lag_motors(log, time_constant) for log in self.logs), strict=True)
        records = [each | {"done": [*each["done"], line]} for each, line in zip(self.records, lines, strict=True)]
        return LogSet(self.label, list(logs), records, self.left)


def load_logs(option: str, folder: Path, vehicle: Vehicle, time_constant: float, config: RealFlightConfig) -> LogSet:
    """Read, check and clean all logs of a folder, which the given option named; rotors lag by the time constant [s].

    Raises:
        ChecksFailed: a check failed, without --anyway.
    """
    dt = config.cleaning.resample
    try:
        raws, left = read_folder(folder, **config.reading)
    except ValueError as error:
        about_folder = str(error).startswith(f"{folder}: ")
        raise ValueError(f"--{option} {error}" if about_folder else str(error)) from error
    # Before they become flights, which those that fail might not do.
    found = [check_recording(raw, vehicle, dt or own_interval(raw)) for raw in raws]
    names = [f"{option}/{Path(raw.name).name}" for raw in raws]
    require_checks(list(zip(names, found, strict=True)), config)
    flights = [flight_at(raw, dt, config.polynomial) for raw in raws]
    cleaned = [clean(flight, config.cleaning, vehicle) for flight in flights]
    records = [
        _record(option, flight, log, done, [*checks, *check_log(log, vehicle)], raw.notes)
        for raw, flight, (log, done), checks in zip(raws, flights, cleaned, found, strict=True)
    ]
    logs = LogSet(option, [log for log, _ in cleaned], records, {path.name: why for path, why in left.items()})
    return logs.with_lag(time_constant) if time_constant else logs


def require_checks(found: Sequence[tuple[str, Sequence[Check]]], config: RealFlightConfig) -> None:
    """Raise ChecksFailed with a line for each check that failed, by the names of their flights; not with --anyway."""
    lines = [line for name, checks in found for line in failures(checks, name)]
    if lines and not config.anyway:
        raise ChecksFailed(*lines, MEND)


def require_distinct(sets: Sequence[LogSet], config: RealFlightConfig) -> None:
    """Refuse a flight that occurs twice.

    Source and test may share flights where each is tested by models trained on other manoeuvres.
    """
    shared = config.target is None and config.folds_by == "manoeuvre"
    log_options.require_distinct(
        [
            (f"--{each.label} {log.name}", (each.label if shared else "", record["sha256"]))
            for each in sets
            for log, record in zip(each.logs, each.records, strict=True)
        ]
    )


def _record(
    folder: str, raw: FlightLog, log: FlightLog, done: list[str], checks: Sequence[Check], notes: Sequence[str]
) -> dict[str, Any]:
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
        "notes": notes,
        "fails": sum(check.verdict == FAILS for check in checks),
        "checks": [asdict(replace(c, suggestion=in_flags("real_flight", c.suggestion))) for c in checks],
    }
