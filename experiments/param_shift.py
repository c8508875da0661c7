"""Experiment 1 (paper, Sec. 4.4), Ix 0.02912 → 0.040, Iy 0.02912 → 0.020 kg m²: python -m experiments.param_shift"""

from functools import partial

from experiments.paper.config import PRESETS
from experiments.paper.outcome import adapt_and_report
from experiments.runner import command
from hybrid_jax.sim.domain import PARAMETER_SHIFT

NAME = "param_shift"
ABOUT = "The vehicle's roll and pitch inertia change: adapt to it."
main = partial(command.run, NAME, ABOUT, partial(adapt_and_report, NAME, PARAMETER_SHIFT, 0.0), presets=PRESETS)

if __name__ == "__main__":
    main()
