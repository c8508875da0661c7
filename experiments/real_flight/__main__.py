"""How well models predict recorded flights that they were not trained on: python -m experiments.real_flight --help."""

import sys
from collections.abc import Sequence
from dataclasses import replace

from rich.console import Console

from experiments.real_flight.config import OPTIONS, PRESETS, RealFlightConfig
from experiments.real_flight.report import NAME, write
from experiments.real_flight.simulated import write_logs
from experiments.real_flight.study import run_folds
from experiments.runner import command
from experiments.runner.stages import stages_of
from hybrid_jax.cli.command import BAD_INPUT
from hybrid_jax.cli.logs import Flights, read_flights, require_distinct
from hybrid_jax.dynamics.vehicle_file import VehicleModel, load_vehicle_model
from hybrid_jax.identification.learning import STEPS, learnable

ABOUT = "How well do models that `hybrid-jax fit` and `adapt` learn predict other flights?"
GUIDE = """\
real_flight needs flights: --vehicle FILE --before FOLDER [--after FOLDER] [--test FOLDER], or --simulated.

  No logs at hand?  python -m experiments.real_flight --simulated --preset smoke
  writes logs of a simulated vehicle before and after a change to runs/real_flight/logs and trains on them. The files
  show the format of the logs.

  Your own logs: PX4, Crazyflie, ROS, Betaflight or CSV, one file per flight; hybrid-jax inspect FOLDER says what is in
  them and what to do, and hybrid-jax fit learns from them without folds. docs/howto/logs.md explains the formats.

  Public flights: IMRCLab/crazyflie-data-collection (a Crazyflie with and without a load) and
  idsia-robotics/nanodrone-sysid-benchmark on GitHub. Both need a column map and have licences of their own."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the experiment; without any flights, explain how to get some and exit with code 2."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not any(word.startswith(("--simulated", "--before", "--vehicle")) for word in given):
        command.check(NAME, ABOUT, given, PRESETS)  # a wrong option is named before flights are asked for
        print(GUIDE, file=sys.stderr)
        sys.exit(BAD_INPUT)
    command.run(NAME, ABOUT, run, given, presets=PRESETS)


def run(config: RealFlightConfig, console: Console) -> None:
    model, sets = prepare(config)
    stages = stages_of(config, console)
    write(config, sets, *run_folds(config, model, sets, stages), stages)


def prepare(config: RealFlightConfig) -> tuple[VehicleModel, dict[str, Flights]]:
    """Return the vehicle, and the flights of each folder, read like `fit` and `adapt` read them."""
    path, named = config.vehicle, {name: getattr(config, name) for name in ("source", "target", "test")}
    folders = {name: folder for name, folder in named.items() if folder is not None}
    if config.simulated:
        path, folders = write_logs(config.out / NAME / "logs", config.data_seed)
    if path is None or "source" not in folders:
        raise ValueError("--vehicle FILE and --before FOLDER are needed, or --simulated; see --help")
    model = load_vehicle_model(path)
    model = replace(model, learn=config.learn or model.learn)
    changed = "target" in folders
    sets = {
        name: read_flights(folder, model.vehicle, config.dt, config, changed and name != "source")
        for name, folder in folders.items()
    }
    # Source and test may share flights where each is tested by models that were trained on other manoeuvres.
    shared = not changed and config.folds_by == "manoeuvre"
    contents = [(each, name, content) for each, found in sets.items() for name, content in found.contents.items()]
    require_distinct([(f"{OPTIONS[each]} {name}", (each * shared, content)) for each, name, content in contents])
    source = sets["source"]
    return learnable(model, source.seconds, STEPS * config.dt)[0], sets


if __name__ == "__main__":
    main()
