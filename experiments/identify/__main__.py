"""Identify a vehicle from logs of commands: python -m experiments.identify --help"""

import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from experiments.identify.report import figure, tables
from experiments.reporting.report import Report, write_report
from experiments.reporting.results import Results
from experiments.runner import command
from experiments.runner.run_record import environment
from hybrid_jax import checks, runtime
from hybrid_jax.dynamics.actuators import Actuated
from hybrid_jax.dynamics.measurement import MEASURED
from hybrid_jax.dynamics.vehicle_file import VehicleModel, load_vehicle_model
from hybrid_jax.flights.reading import find_logs, read_recording
from hybrid_jax.flights.recording import Recording
from hybrid_jax.identification.fitting import identify, identify_in_turn
from hybrid_jax.identification.measured import Initial, Layout
from hybrid_jax.io import save

NAME = "identify"


@dataclass(frozen=True)
class Config:
    """Learn what a vehicle is from logs of its commands and of whatever was measured beside them.

    The vehicle file names what is known and, in `learn`, what is not. With commands instead of rotor speeds it needs a
    table [actuator], such as

        learn = ["curve", "time_constant", "Ix", "Iy", "delay"]
        [actuator]
        curve = [0.0, 0.0, 0.15]     # thrust of a rotor [N]: c0 + c1 command + c2 command², to start from
        gives = "thrust"             # or "speed" [rad/s]
        time_constants = 0.05        # s; or [up, down]

    Position, velocity, attitude, body rates and accelerometer may each be missing. Each parameter comes with a 95 %
    interval; one that the logs do not tell has an infinite one.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of logs of any format that is read, or one log."""
    vehicle: Path
    """Vehicle file (TOML)."""
    learn: tuple[str, ...] = ()
    """Names of parameters, in the place of those of the vehicle file."""
    test: tuple[Path, ...] = ()
    """Logs left out of the fit, and predicted with its result."""
    model: Path | None = None
    """File for the identified model, which hybrid_jax.load reads."""
    out: Path = Path("runs/identify")
    """Folder of the report."""
    measured: tuple[str, ...] = ()
    """Quantities that are compared, such as rates specific_force; by default all that every log has."""
    together: bool = False
    """Fit all parameters at once; by default those of the thrust first, from the accelerometer, where there is one."""
    initial: Initial = "estimated"
    """The state that a window starts from: estimated from the samples before it, or the last sample as it is."""
    dt: float = 0.005
    """Steps of the solver, and of the grid on which measurements are compared [s]."""
    steps: int = 20
    """Steps of a window. Short ones resist slow disturbances, long ones tell slow effects."""
    windows: int = 300
    """Windows at most, spread evenly over the logs."""
    columns: Path | None = None
    """Column map of CSV logs."""
    motor_order: tuple[int, ...] = ()
    """Which motor of the log, from 0, each rotor of the vehicle is."""

    @property
    def layout(self) -> Layout:
        return Layout(self.dt, self.steps, self.windows, initial=self.initial)


def recordings(config: Config) -> tuple[list[Recording], list[Recording]]:
    """Logs to learn from, and those left out."""
    read = partial(read_recording, columns=config.columns, motor_order=config.motor_order)
    out = [read(path) for path in config.test]
    files = find_logs(config.folder)[0] if config.folder.is_dir() else [config.folder]
    left = {path.resolve() for path in config.test}
    found = [read(path) for path in files if path.resolve() not in left]
    if not found:
        raise ValueError(f"{config.folder}: holds no log besides those of --test")
    return found, out


def field_of(config: Config, logs: list[Recording]):
    """The field to start from: told commands if the logs have any and the vehicle file has a table [actuator]."""
    model: VehicleModel = load_vehicle_model(config.vehicle)
    model = replace(model, learn=config.learn) if config.learn else model
    for log in logs:
        if log.rotors != model.vehicle.rotors:
            raise ValueError(f"{log.name}: has {log.rotors} motors, {config.vehicle} has {model.vehicle.rotors}")
    commanded = model.actuator is not None and all("command" in log.signals for log in logs)
    if not commanded and not all("rotor_speed" in log.signals for log in logs):
        raise ValueError(f"{config.vehicle}: logs of commands need a table [actuator]; see --help")
    return model.commanded() if commanded else model.physics()


def run(config: Config) -> None:
    checks.writable_folder("--out", config.out)
    runtime.configure()
    console, began = Console(stderr=True), time.perf_counter()
    logs, left_out = recordings(config)
    field = field_of(config, logs)
    for name in config.measured:
        if name not in MEASURED:
            raise ValueError(f"--measured must be of {', '.join(MEASURED)}, got {name!r}")
    alone = config.together or config.measured or not isinstance(field, Actuated)
    console.print(f"identifying {', '.join(log.name for log in logs)}", highlight=False, soft_wrap=True)
    if alone:
        found = identify(field, logs, config.layout, config.measured)
    else:
        found = identify_in_turn(field, logs, config.layout)
    seconds = time.perf_counter() - began
    if config.model is not None:
        save(config.model, found.field, {"dt": config.dt})
    rows, shown, notes = tables(found, logs, left_out, config.layout, tuple(found.errors))
    pictures = figure(config.out, found, logs, left_out, config.layout, tuple(found.errors))
    report = Report(
        NAME,
        {name: str(value) for name, value in asdict(config).items()},
        environment({"identification": seconds}),
        Results(rows),
        figures=pictures,
        notes=notes,
        tables=shown,
        head=f"# What {', '.join(Path(log.name).name for log in logs)} tell of the vehicle",
    )
    write_report(config.out, report, console)


main = partial(command.call, NAME, Config, run)

if __name__ == "__main__":
    main()
