"""How well models predict recorded flights that they were not trained on: python -m experiments.real_flight --help."""

import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from rich.console import Console

from experiments.real_flight import logs
from experiments.real_flight.config import LEARN, PRESETS, RealFlightConfig
from experiments.real_flight.folds import evenly_spaced, hold_out_validation
from experiments.real_flight.log_tables import failed_checks
from experiments.real_flight.logs import LogSet
from experiments.real_flight.models import thrust_baseline
from experiments.real_flight.report import write_report
from experiments.real_flight.scoring import INTERVAL_STEPS, relative_error
from experiments.real_flight.simulated import write_logs
from experiments.real_flight.study import run_folds
from experiments.real_flight.train import Experiment
from experiments.runner import command
from experiments.runner.stages import stages_of
from hybrid_jax.cli.command import BAD_INPUT, ChecksFailed, split_lists
from hybrid_jax.dynamics.vehicle_file import LAG, NEED_PURPOSE, VehicleModel, learned_by_field, vehicle_model_of
from hybrid_jax.estimation.least_squares import fit_least_squares
from hybrid_jax.flights.checks.cleaning import TIME_CONSTANTS, lag_motors
from hybrid_jax.flights.checks.consistency import FAILS
from hybrid_jax.flights.scores import flight_errors
from hybrid_jax.flights.windows import cut_windows, require_common_interval
from hybrid_jax.sweep import hosts
from hybrid_jax.vehicle import read_tables

NAME = "real_flight"
LAG_WINDOWS = 300  # windows that physics is fitted to for each candidate of the rotors' time constant
ABOUT = "How well does a model of your own vehicle predict flights that it was not trained on?"
GUIDE = """\
real_flight needs flights: --vehicle FILE --source FOLDER [--target FOLDER] [--test FOLDER], or --simulated.

  No logs at hand?  python -m experiments.real_flight --simulated --preset smoke
  writes logs of a simulated vehicle before and after a change to runs/real_flight/logs and trains on them. The files
  show the format of the logs.

  Your own logs: one file per flight, CSV with the columns t,px,py,pz,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,u0,u1,u2,u3 (SI
  units, z up, forward-left-up, rotor speeds in rad/s); any other CSV with --columns MAP.toml; PX4's .ulg; a log of a
  Crazyflie's SD card; a ROS bag. hybrid-jax inspect FOLDER says what is in them and what to do. Ten
  flights of ten seconds before the change and five after it are a good start. docs/howto/logs.md explains the formats.

  Public flights: IMRCLab/crazyflie-data-collection (a Crazyflie with and without a load) and
  idsia-robotics/nanodrone-sysid-benchmark on GitHub. Both need a column map and have licences of their own."""
# Options that take several values.
LISTS = ("--horizon", "--n", "--polynomial", "--motor-order", "--topics", "--learn", "--recipes", "--models")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the experiment; without any flights, print how to get some and exit with code 2."""
    given = split_lists(sys.argv[1:] if arguments is None else arguments, LISTS)
    if not any(word.startswith(("--simulated", "--source", "--vehicle")) for word in given):
        command.check(NAME, ABOUT, given, PRESETS)  # a wrong option is named before flights are asked for
        print(GUIDE, file=sys.stderr)
        sys.exit(BAD_INPUT)
    command.run(NAME, ABOUT, run, given, presets=PRESETS)


def run(config: RealFlightConfig, console: Console) -> None:
    experiment = prepare(config, console)
    outputs = run_folds(experiment)
    if hosts.is_main_process():
        write_report(NAME, experiment, outputs, Console())


def prepare(config: RealFlightConfig, console: Console) -> Experiment:
    path, named = config.vehicle, {name: getattr(config, name) for name in ("source", "target", "test")}
    folders = {name: folder for name, folder in named.items() if folder is not None}
    if config.simulated:
        path, folders = write_logs(config.out / NAME / "logs", config.data_seed)
    if path is None or "source" not in folders:
        raise ValueError("--vehicle FILE and --source FOLDER are needed, or --simulated; see --help")
    before, after, chooses_lag, not_learned = load_vehicle_models(path, config)
    # The time constant may not be chosen on flights, or manoeuvres, that models are tested on.
    if chooses_lag and "target" not in folders and ("test" not in folders or config.folds_by == "manoeuvre"):
        raise ValueError(
            f"learn: {LAG} is chosen on flights of --source, and without --target these are test flights as well; "
            f"give --target, or state {LAG} under [terms]"
        )
    sets: dict[str, LogSet] = {}
    for name, folder in folders.items():
        model = before if name == "source" else after
        time_constant = 0.0 if chooses_lag else model.terms.motor_time_constant
        sets[name] = logs.load_logs(name, folder, model.vehicle, time_constant, config)
    logs.require_distinct(list(sets.values()), config)
    dt = require_common_interval([log for each in sets.values() for log in each.logs])
    if chooses_lag:
        chosen = choose_lag(sets["source"], before, config)
        console.print(f"rotor time constant: {1000 * chosen:.1f} ms", highlight=False)
        sets = {name: each.with_lag(chosen) for name, each in sets.items()}
    say = partial(console.print, highlight=False, soft_wrap=True, markup=False)
    if not_learned:
        say(not_learned)
    for each in sets.values():
        for file, why in each.left.items():
            say(f"{each.label}/{file}: left: {why}")
        for record in each.records:
            for note in record["notes"]:
                say(f"{each.label}/{record['flight']}: {note}")
    found = failed_checks([record for each in sets.values() for record in each.records])
    failed = []
    for flight, check in found:
        line = f"{flight}: {check['name']}: {check['suggestion']}"  # the report holds the whole table
        if check["verdict"] == FAILS and not config.anyway:
            failed.append(line)
        else:
            say(line, style="yellow")
    if failed:
        raise ChecksFailed(*failed, logs.MEND)
    return Experiment(config, before, after, sets, dt, stages_of(config, console))


def load_vehicle_models(path: Path, config: RealFlightConfig) -> tuple[VehicleModel, VehicleModel, bool, str]:
    """Read the vehicle of the source, and that of target and test.

    Returns also whether the rotors' time constant is chosen, and a line on what is not learned; empty if all is.
    """
    tables = read_tables(path)
    before, after = (vehicle_model_of(tables, path, variant) for variant in (None, config.target_variant))
    asked = config.learn or (before.learn if "learn" in tables else LEARN)
    aimless = tuple(name for name in asked if name in NEED_PURPOSE and name not in before.purpose)
    learn = tuple(name for name in asked if name not in aimless)
    before, after = (replace(each, learn=learned_by_field(learn)) for each in (before, after))
    names = ", ".join(aimless)
    why = f"{path}: {names} is not learned, as the file does not say what it is for; above its tables: purpose = "
    return before, after, LAG in learn, f'{why}{{ {aimless[0]} = "why" }}' if aimless else ""


def choose_lag(source: LogSet, model: VehicleModel, config: RealFlightConfig) -> float:
    """Choose the rotors' time constant [s]: physics fitted to the source's training flights predicts the others."""
    parts, baseline = hold_out_validation(source.logs, config), thrust_baseline(model)

    def error(lag: float) -> float:
        lagging = ([lag_motors(log, lag)[0] for log in logs] for logs in parts)
        known, unknown = (cut_windows(logs, INTERVAL_STEPS).windows for logs in lagging)
        field = fit_least_squares(model.physics(), evenly_spaced(known, LAG_WINDOWS)).field
        return relative_error(flight_errors(field, unknown), flight_errors(baseline, unknown), (INTERVAL_STEPS,))

    errors = {lag: found for lag in TIME_CONSTANTS if math.isfinite(found := error(lag))}
    if not errors:
        raise ValueError("no time constant of the rotors has a finite error, so none can be chosen")
    return min(errors, key=lambda lag: errors[lag])


if __name__ == "__main__":
    main()
