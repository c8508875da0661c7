"""Experiment 1 (paper, Sec. 4.4): the inertia shifts, Ix 0.02912 → 0.040, Iy 0.02912 → 0.020 kg m².

python -m experiments.param_shift --help
"""

from rich.console import Console

from experiments.paper.config import PRESETS, AdaptationConfig
from experiments.paper.outcome import write_outcome
from experiments.paper.study import study
from experiments.runner import command
from hybrid_jax.sim.domain import PARAMETER_SHIFT
from hybrid_jax.sweep import hosts
from hybrid_jax.vehicle import IRIS

NAME, TITLE = "param_shift", "Parameter shift"


def experiment(config: AdaptationConfig, console: Console) -> None:
    """Run the protocol on the shifted vehicle and write the report."""
    found = study(PARAMETER_SHIFT, IRIS, config, console)
    if hosts.is_main_process():
        write_outcome(NAME, TITLE, PARAMETER_SHIFT, config, found)


def main() -> None:
    """The command line."""
    command.run(NAME, "The vehicle's roll and pitch inertia change: adapt to it.", experiment, presets=PRESETS)


if __name__ == "__main__":
    main()
