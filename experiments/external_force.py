"""Experiment 2 (paper, Sec. 4.5), a side wind of [0, −4 + sin(2π t / 3), 0] N: python -m experiments.external_force"""

from functools import partial

import numpy as np

from experiments.paper.config import PRESETS
from experiments.paper.outcome import adapt_and_report
from experiments.paper.study import EVERY
from experiments.runner import command
from hybrid_jax.sim.domain import EXTERNAL_FORCE
from hybrid_jax.sim.flight import DT
from hybrid_jax.sim.forces import WIND_AMPLITUDE, WIND_ANGULAR_FREQUENCY
from hybrid_jax.vehicle import IRIS

NAME = "external_force"
ABOUT = "A side wind that no source flight had: adapt to it."


def sine_floor(mass: float, times: np.ndarray) -> float:
    """L_MSE at the times [s] of an exact model without the wind's sine, which ẋ = f(x, u) cannot represent.

    For an acceleration (A / m) sin(ω t) with a random phase at the start, the mean squares over the phase are
    (A / m)² (1 − cos ωs) / ω² in velocity and (A / m)² (s² / 2ω² + (1 − cos ωs) / ω⁴ − s sin ωs / ω³) in position.
    """
    w, s = WIND_ANGULAR_FREQUENCY, times
    velocity = (1 - np.cos(w * s)) / w**2
    position = s**2 / (2 * w**2) + (1 - np.cos(w * s)) / w**4 - s * np.sin(w * s) / w**3
    return float((WIND_AMPLITUDE / mass) ** 2 * np.mean(velocity + position))


FLOOR = sine_floor(IRIS.mass, DT * np.arange(EVERY, 101, EVERY))  # on test flights


main = partial(command.run, NAME, ABOUT, partial(adapt_and_report, NAME, EXTERNAL_FORCE, FLOOR), presets=PRESETS)

if __name__ == "__main__":
    main()
