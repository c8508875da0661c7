"""Identify a vehicle from logs of commands: python -m experiments.identify --help"""

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from experiments.identify.checked import check_consistent, check_whole
from experiments.identify.report import figure, tables
from experiments.reporting.report import Report, write_report
from experiments.reporting.results import Results
from experiments.runner import command
from experiments.runner.options import Count, Positive, check_numbers
from experiments.runner.run_record import environment
from hybrid_jax import checks, runtime
from hybrid_jax.cli.command import split_lists
from hybrid_jax.cli.log_options import LogOptions, require_distinct
from hybrid_jax.cli.logs import content_of
from hybrid_jax.dynamics.actuators import NAMES, Actuated
from hybrid_jax.dynamics.measurement import MEASURED
from hybrid_jax.dynamics.vehicle_file import LAG, VehicleModel, load_vehicle_model
from hybrid_jax.flights.load import find_logs, read_recording
from hybrid_jax.flights.recording import Recording
from hybrid_jax.identification.fitting import identify, identify_in_turn
from hybrid_jax.identification.recordings import Initial, Layout
from hybrid_jax.io import save

NAME = "identify"
LISTS = ("--learn", "--measured", "--motor-order", "--topics")
ANYWAY = "{} checks of the logs failed, and --anyway went on: no number below counts until they pass."


@dataclass(frozen=True)
class Config(LogOptions):
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

    Logs are checked first, as far as their signals allow. A check that fails stops with exit code 3; --anyway goes on.
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
    dt: Positive = 0.005
    """Steps of the solver, and of the grid on which measurements are compared [s]."""
    steps: Count = 20
    """Steps of a window. Short ones resist slow disturbances, long ones tell slow effects."""
    windows: Count = 300
    """Windows at most, spread evenly over the logs."""
    anyway: bool = False
    """Go on although checks of the logs failed: the page then says so first."""

    @property
    def layout(self) -> Layout:
        return Layout(self.dt, self.steps, self.windows, initial=self.initial)


def recordings(config: Config) -> tuple[list[Recording], list[Recording], list[str]]:
    """Logs to learn from, and those left out; also what their readers say, and which files were not read."""
    read = partial(read_recording, **config.reading)
    out = [read(path) for path in config.test]
    files, others = find_logs(config.folder) if config.folder.is_dir() else ([config.folder], {})
    left = {path.resolve() for path in config.test}
    found = [read(path) for path in files if path.resolve() not in left]
    if not found:
        raise ValueError(f"{config.folder}: holds no log besides those of --test")
    said = [f"{path.name}: left: {why}" for path, why in others.items()]
    return found, out, said + [f"{Path(log.name).name}: {note}" for log in (*found, *out) for note in log.notes]


def model_of(config: Config) -> VehicleModel:
    model = load_vehicle_model(config.vehicle)
    model = replace(model, learn=config.learn) if config.learn else model
    if not model.learn:
        raise ValueError(f"{config.vehicle}: learn: names nothing; give --learn Ix Iy, or what else is not known")
    if LAG in model.learn:
        raise ValueError(f"{config.vehicle}: learn: {LAG} is for real_flight alone: {_learn(model.learn, (LAG,))}")
    return model


def field_of(config: Config, model: VehicleModel, logs: list[Recording], left_out: list[Recording]):
    """The field to start from: told commands if the logs have any and the vehicle file has a table [actuator]."""
    for log in (*logs, *left_out):
        if log.rotors != model.vehicle.rotors:
            raise ValueError(f"{log.name}: has {log.rotors} motors, {config.vehicle} has {model.vehicle.rotors}")
    speeds_alone = [log.name for log in logs if "command" not in log.signals]
    told = "command" if model.actuator is not None and not speeds_alone else "rotor_speed"
    for log in logs if told == "rotor_speed" else ():
        if told not in log.signals:
            mend = f"leave out {speeds_alone[0]}" if speeds_alone else "give it a table [actuator]; see --help"
            raise ValueError(f"{config.vehicle}: {log.name} has commands and no rotor speeds: {mend}")
    for log in left_out:
        if told not in log.signals:
            raise ValueError(f"--test {log.name}: has no {told}, which the other logs have; leave it out")
    if told == "command":
        return model.commanded()
    if lost := [name for name in model.learn if name in NAMES]:
        why = f"need commands, and {speeds_alone[0]} has rotor speeds alone"
        raise ValueError(f"{config.vehicle}: learn: {', '.join(lost)}: {why}: {_learn(model.learn, lost)}")
    return model.physics()


def _learn(names: Sequence[str], without: Sequence[str]) -> str:
    """What to type to learn all but some parameters."""
    return f"give --learn {' '.join(name for name in names if name not in without) or 'Ix Iy'}"


def checked(config: Config, console: Console):
    """The logs to learn from, those left out, the field to start from, lines for the page, and failed checks.

    Raises:
        ChecksFailed: a check failed, without --anyway.
    """
    model, (logs, left_out, said) = model_of(config), recordings(config)
    # It could be fitted and predicted.
    named = [*((log.name, log) for log in logs), *((f"--test {log.name}", log) for log in left_out)]
    require_distinct([(name, content_of(log)) for name, log in named])
    say = partial(console.print, highlight=False, soft_wrap=True, markup=False)
    for line in said:
        say(line)
    failed = check_whole([*logs, *left_out], model.vehicle, config.anyway)
    field = field_of(config, model, logs, left_out)
    failed += check_consistent([*logs, *left_out], field, model.learn, config.anyway)
    for line in failed:
        say(line, style="yellow")
    return logs, left_out, field, said, failed


def run(config: Config) -> None:
    check_numbers("--", config)
    for name in config.measured:
        if name not in MEASURED:
            raise ValueError(f"--measured must be of {', '.join(MEASURED)}, got {name!r}")
    checks.writable_folder("--out", config.out)
    runtime.configure()
    console, began = Console(stderr=True), time.perf_counter()
    logs, left_out, field, said, failed = checked(config, console)
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
        notes=[*notes, *said, *failed],
        tables=shown,
        head=f"# What {', '.join(Path(log.name).name for log in logs)} tell of the vehicle",
        warnings=[ANYWAY.format(len(failed))] if failed else [],
    )
    write_report(config.out, report, console)


def main(arguments: Sequence[str] | None = None) -> None:
    given = list(sys.argv[1:] if arguments is None else arguments)
    command.call(NAME, Config, run, split_lists(given, LISTS))


if __name__ == "__main__":
    main()
