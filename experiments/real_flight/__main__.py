"""Your own logs: learn from flights before a change, adapt to a few after it, score on flights not seen.

python -m experiments.real_flight --help
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from experiments.real_flight.config import LEARN, PRESETS, RealFlightConfig
from experiments.real_flight.folds import Fold, hold_out_validation, thinned
from experiments.real_flight.logs import Flown, cut, fly_in, require_distinct, require_one_rate
from experiments.real_flight.models import Craft
from experiments.real_flight.outcome import Outcome, write_outcome
from experiments.real_flight.scoring import INTERVAL_STEPS, relative_error
from experiments.real_flight.simulated_logs import write_logs
from experiments.real_flight.study import study
from experiments.runner import command
from hybrid_jax.adaptation.least_squares import fit_least_squares
from hybrid_jax.dynamics.multirotor import multirotor
from hybrid_jax.dynamics.vehicle_file import LAG, load_description, of_field
from hybrid_jax.flights.cleaning import lag_motors
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.rotor_lag import choose_time_constant
from hybrid_jax.flights.scores import flight_errors
from hybrid_jax.sweep import hosts
from hybrid_jax.vehicle import read_tables

NAME = "real_flight"
ABOUT = "How well can a model of your own vehicle predict flights that it has not seen?"
GUIDE = """\
real_flight needs flights: --vehicle FILE --source FOLDER [--target FOLDER] [--test FOLDER], or --simulated.

  No logs at hand?  python -m experiments.real_flight --simulated --preset smoke
  writes logs of a simulated vehicle before and after a change to runs/real_flight/logs and learns from them: the files
  show what yours should look like.

  Your own logs: one file a flight, CSV with the columns t,px,py,pz,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,u0,u1,u2,u3 (SI units,
  z up, forward-left-up, rotor speeds in rad/s); any other CSV with --columns MAP.toml; or PX4's .ulg. Ten flights of
  ten seconds before the change and five after it are a good start. docs/real_flight.md says how to bring them.

  Flights of others: IMRCLab/crazyflie-data-collection (a Crazyflie with and without a load) and
  idsia-robotics/nanodrone-sysid-benchmark on GitHub; both need a column map, and their licences are theirs."""
LISTS = ("--horizon", "--n", "--polynomial", "--learn", "--recipes", "--models")  # options that take several values
FITTED = 300  # windows that physics is fitted to for each time constant that is tried


def experiment(config: RealFlightConfig, console: Console) -> None:
    """Read, check and clean the logs, train, test, and write what came of it."""
    config.require_flights()
    if config.simulated:
        vehicle, folders = write_logs(config.out / NAME / "logs", config.data_seed)
    else:
        named = {name: getattr(config, name) for name in ("source", "target", "test")}
        vehicle, folders = config.vehicle, {name: path for name, path in named.items() if path is not None}
    assert vehicle is not None
    before, after = crafts(vehicle, config)
    lag_is_learned = LAG in learned(vehicle, config)
    if lag_is_learned:
        require_untested_source(folders, config)
    flown = {
        name: fly_in(name, folder, craft.vehicle, 0.0 if lag_is_learned else craft.terms.motor_time_constant, config)
        for name, folder in folders.items()
        for craft in [before if name == "source" else after]
    }
    require_distinct(list(flown.values()), config)
    dt = require_one_rate(list(flown.values()))
    if lag_is_learned:
        flown = following_rotors(flown, before, config, console)
    say_checks(flown, console)
    found = study(before, after, flown, config, console)
    if hosts.is_main_process():
        write_outcome(Outcome(NAME, config, before, after, flown, dt, found), Console())


def crafts(path: Path, config: RealFlightConfig) -> tuple[Craft, Craft]:
    """The vehicle of the source, and that of target and test.

    Raises:
        ValueError: the file, the key and what was expected, in one line.
    """
    found = [load_description(path), load_description(path, config.target_variant)]
    learn = learned(path, config)
    before, after = (Craft(each.vehicle, each.terms, of_field(learn)) for each in found)
    return before, after


def learned(path: Path, config: RealFlightConfig) -> tuple[str, ...]:
    """Names of what is to be learned: as asked for, or as the vehicle file says, or what real multirotors need.

    Raises:
        ValueError: as `load_description`.
    """
    if config.learn:
        return config.learn
    return load_description(path).learn if "learn" in read_tables(path) else LEARN


def require_untested_source(folders: Mapping[str, Path], config: RealFlightConfig) -> None:
    """Refuse to choose the rotors' time constant on flights, or manoeuvres, that models are tested on.

    Raises:
        ValueError: what to do instead.
    """
    if "target" not in folders and ("test" not in folders or config.folds_by == "manoeuvre"):
        raise ValueError(
            f"learn: {LAG} is chosen on flights of --source, and without --target these take turns in being tested; "
            f"give --target, or state {LAG} under [terms]"
        )


def say_checks(flown: Mapping[str, Flown], console: Console) -> None:
    """A line for each log whose checks fail; the whole table is in the report."""
    for each in flown.values():
        for record in each.records:
            for check in record["checks"]:
                if check["verdict"] == "fails":
                    line = f"{each.label}/{record['flight']}: {check['name']}: {check['suggestion']}"
                    console.print(line, highlight=False, soft_wrap=True, style="yellow")


def following_rotors(
    flown: Mapping[str, Flown], craft: Craft, config: RealFlightConfig, console: Console
) -> dict[str, Flown]:
    """All logs with rotors that follow their motor values by the time constant with which physics predicts best.

    It is chosen on the source's validation flights, by physics that is fitted to the training flights.
    """
    train, validation = hold_out_validation(flown["source"].logs, config)
    baseline = craft.thrust()

    def error(logs: list[FlightLog]) -> float:
        fold = Fold("", logs[: len(train)], logs[len(train) :], [])
        windows = thinned(cut(fold.train, INTERVAL_STEPS).windows, FITTED)
        judged = cut(fold.validation, INTERVAL_STEPS).windows
        fitted = fit_least_squares(multirotor(craft.vehicle, craft.learn, craft.terms), windows).field
        return relative_error(flight_errors(fitted, judged), flight_errors(baseline, judged), (INTERVAL_STEPS,))

    chosen, _ = choose_time_constant([*train, *validation], error)
    console.print(f"rotors follow with a time constant of {1000 * chosen:.1f} ms", highlight=False)
    return {name: _lagged(each, chosen) for name, each in flown.items()}


def _lagged(flown: Flown, time_constant: float) -> Flown:
    changed = [lag_motors(log, time_constant) for log in flown.logs]
    records = [
        record | {"done": [*record["done"], said]} for record, (_, said) in zip(flown.records, changed, strict=True)
    ]
    return Flown(flown.label, [log for log, _ in changed], records)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line. With no flights named, it says how to get some."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not any(word.startswith(("--simulated", "--source", "--vehicle", "--help", "-h")) for word in given):
        print(GUIDE, file=sys.stderr)
        sys.exit(command.BAD_INPUT)
    command.run(NAME, ABOUT, experiment, spaced(given), presets=PRESETS)


def spaced(arguments: Sequence[str]) -> list[str]:
    """What is joined by commas behind an option that takes several values, such as 10,50, as separate words."""
    words: list[str] = []
    option = ""
    for word in arguments:
        named = word.startswith("--")
        option, _, value = word.partition("=") if named else (option, "", word)
        if option not in LISTS or word == option:
            words.append(word)
        else:
            words += [*([option] if named else []), *value.split(",")]
    return words


if __name__ == "__main__":
    main()
