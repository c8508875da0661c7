"""From the command line to the page: python -m experiments.inspect_logs --help."""

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from experiments.inspect_logs.estimates import estimate
from experiments.inspect_logs.page import Inspected, write_page
from experiments.inspect_logs.vehicle import vehicle_text
from experiments.runner import command
from experiments.runner.options import Positive, check_numbers
from hybrid_jax.cli.command import split_lists
from hybrid_jax.cli.flags import in_flags
from hybrid_jax.cli.log_options import SpeedOptions
from hybrid_jax.dynamics.vehicle_file import load_vehicle_model
from hybrid_jax.flights.checks.consistency import FAILS, check_log
from hybrid_jax.flights.load import RawLog, find_logs, read_log, read_recording
from hybrid_jax.flights.log import even_segments
from hybrid_jax.flights.recording import Recording
from hybrid_jax.flights.windows import require_length
from hybrid_jax.io.files import json_value, write_atomic
from hybrid_jax.vehicle import Vehicle

NAME = "inspect_logs"
LISTS = ("--polynomial", "--motor-order", "--topics")
WINDOW = 10  # intervals, as of load_windows
DT, ONE_TO_ONE = 0.01, (0.0, 1.0)  # s; rotor speed = command
# Checks that a log may fail and still tell of its vehicle: it needs no position, and is cut at gaps and on the ground.
BORNE = ("quantities", "slowest signal", "gaps", "repeated samples", "time on the ground")


@dataclass(frozen=True)
class Options(SpeedOptions):
    """Say what is in the logs of a folder, whether it suffices for a model, and what to log instead.

    Reads PX4's .ulg, logs of a Crazyflie's SD card, ROS bags, Betaflight's blackbox and CSV, each file by itself, so
    that one that is damaged hides no other. Nothing is trained and no log is changed. OUT/inspect_logs/report.md holds
    every signal with its rate, all checks with what mends those that fail, and pictures.

    First look at the logs, then write a vehicle file from them, correct it by hand, and look again with it:

      python -m experiments.inspect_logs flights/
      python -m experiments.inspect_logs flights/ --write-vehicle v.toml --mass 0.68 --arm 0.12
      python -m experiments.inspect_logs flights/ --vehicle v.toml
      python -m experiments.real_flight --vehicle v.toml --source flights/
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of logs, or one log."""
    vehicle: Path | None = None
    """Vehicle file that the logs are compared with: number and order of motors, spin, thrust, largest speed."""
    write_vehicle: Path | None = None
    """Write a vehicle file to start from: hover and thrust, where the rotors are, spin, lag and centre of thrust as the
    logs tell that fail no check, with a comment on each number that they do not. No file is overwritten."""
    mass: Positive | None = None
    """With --write-vehicle: what the vehicle weighs [kg]. No log tells it; thrust and inertia grow with it."""
    arm: Positive | None = None
    """With --write-vehicle: distance of a rotor from the centre [m]. No log tells it; inertia grows with it."""
    dt: Positive = DT
    """Interval [s] that a model is to have. A signal that is slower fails a check, as half of it would be invented."""
    out: Path = Path("runs")
    """Folder for the page; the subfolder inspect_logs is created in it."""


def main(arguments: Sequence[str] | None = None) -> None:
    given = list(sys.argv[1:] if arguments is None else arguments)
    command.call(NAME, Options, inspect, split_lists(given, LISTS))


def inspect(options: Options) -> None:
    check_numbers("--", options)
    _ = options.reading  # topics are checked before anything is read
    if options.write_vehicle is not None and options.write_vehicle.exists():
        raise ValueError(f"--write-vehicle: {options.write_vehicle} exists; name another file")
    vehicle = None if options.vehicle is None else load_vehicle_model(options.vehicle).vehicle
    folder = options.folder
    if not folder.exists():
        raise ValueError(f"{folder}: no such file or folder")
    paths, left = find_logs(folder) if folder.is_dir() else ([folder], {})
    if not paths:
        others = "; ".join(f"{path.name}: {why.replace('FILE', path.name)}" for path, why in left.items())
        raise ValueError(f"{folder}: holds no logs, only {others or 'nothing'}")
    logs = [look(path, vehicle, options) for path in paths]
    console = Console()
    write_page(options.out / NAME, logs, left, json_value(_described(options)), console)
    if options.write_vehicle is not None:
        found = estimate(trusted(logs, console))
        write_atomic(options.write_vehicle, vehicle_text(found, folder.resolve().stem, options.mass, options.arm))
        console.print(f"{options.write_vehicle}: written; read its comments before it is used", highlight=False)
    if all(log.raw is None for log in logs):
        raise SystemExit(2)  # the lines above say why


def look(path: Path, vehicle: Vehicle | None, options: Options) -> Inspected:
    """Read and check one log; what refuses it is part of the result."""
    try:
        raw = _read(path, options)
    except ValueError as error:
        return Inspected(path, None, [], in_flags(NAME, str(error)))
    checks, refusal = raw.checks(vehicle, options.dt), ""
    # The checks that need no vehicle bear motors in any unit, so commands are compared whatever speed they stand for.
    unscaled = "rotor_speed" not in raw.recording.signals and not options.polynomial
    try:
        flight = raw.flight(options.dt, ONE_TO_ONE if unscaled else options.polynomial)
        other = vehicle is not None and flight.u.shape[1] != vehicle.rotors  # a check that failed says so
        checks += check_log(flight, None if other or unscaled else vehicle)
        even_segments(flight)
        require_length([flight], WINDOW)
        if unscaled:
            raw.flight(options.dt)  # says what is missing
    except ValueError as error:
        refusal = in_flags(NAME, str(error))
    checks = [replace(check, suggestion=in_flags(NAME, check.suggestion)) for check in checks]
    return Inspected(path, raw, checks, refusal)


def trusted(logs: Sequence[Inspected], console: Console) -> list[Recording]:
    """The recordings that a vehicle file may rest on; which are not is printed."""
    failed = {
        log.path.name: any(check.verdict == FAILS and check.name not in BORNE for check in log.checks) for log in logs
    }
    kept = [log.raw.recording for log in logs if log.raw is not None and not failed[log.path.name]]
    if not kept:
        raise ValueError("--write-vehicle: no log flew and passed its checks; mend the logs as the page says")
    if left := [name for name, fails in failed.items() if fails]:
        console.print(f"left out of the vehicle file, as checks failed: {', '.join(left)}", highlight=False)
    return kept


def _read(path: Path, options: Options) -> RawLog:
    """The log, also where it is a CSV file without all that a flight needs."""
    if options.columns is not None and path.name.lower().endswith((".csv", ".csv.gz")):
        return RawLog(read_recording(path, **options.reading))
    return read_log(path, **options.reading)


def _described(options: Options) -> dict:
    return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(options).items()}


if __name__ == "__main__":
    main()
