"""The command line: python -m experiments.real_flight --help."""

import sys
from collections.abc import Sequence

from experiments.real_flight.config import PRESETS
from experiments.real_flight.experiment import NAME, run
from experiments.runner import command

ABOUT = "How well does a model of your own vehicle predict flights that it was not trained on?"
GUIDE = """\
real_flight needs flights: --vehicle FILE --source FOLDER [--target FOLDER] [--test FOLDER], or --simulated.

  No logs at hand?  python -m experiments.real_flight --simulated --preset smoke
  writes logs of a simulated vehicle before and after a change to runs/real_flight/logs and trains on them. The files
  show the format of the logs.

  Your own logs: one file per flight, CSV with the columns t,px,py,pz,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,u0,u1,u2,u3 (SI
  units, z up, forward-left-up, rotor speeds in rad/s); any other CSV with --columns MAP.toml; or PX4's .ulg. Ten
  flights of ten seconds before the change and five after it are a good start. docs/real_flight.md explains the formats.

  Public flights: IMRCLab/crazyflie-data-collection (a Crazyflie with and without a load) and
  idsia-robotics/nanodrone-sysid-benchmark on GitHub. Both need a column map and have licences of their own."""
LISTS = ("--horizon", "--n", "--polynomial", "--learn", "--recipes", "--models")  # options that take several values


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the experiment; without any flights, print how to get some and exit with code 2."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not any(word.startswith(("--simulated", "--source", "--vehicle", "--help", "-h")) for word in given):
        print(GUIDE, file=sys.stderr)
        sys.exit(command.BAD_INPUT)
    command.run(NAME, ABOUT, run, split_lists(given), presets=PRESETS)


def split_lists(arguments: Sequence[str]) -> list[str]:
    """Split comma-separated values, such as 10,50, of the options that take several values."""
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
