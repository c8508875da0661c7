"""References, and the hardware between controller and vehicle."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import control
from hybrid_jax.control import Controller, Hardware, sample
from hybrid_jax.control.cost import Scalar
from hybrid_jax.control.references import Path
from hybrid_jax.vehicle import SENSOR_NOISE

ALTITUDE = 1.5  # m


def _crossing(t: Scalar) -> tuple[Float[Array, "3"], Scalar]:
    """A low pass that crosses home after 5 s."""
    position, yaw = control.low_flyby(speed=2.0)(t)
    return position - jnp.array([10.0, 0.0, 0.0]), yaw


PATHS: Mapping[str, Path] = {
    "hover": control.hover((0.0, 0.0, ALTITUDE)),
    "figure_eight": control.figure_eight(3.5, altitude=ALTITUDE),
    "fast_figure_eight": control.figure_eight(6.0, altitude=ALTITUDE),
    "step": control.step((1.0, 1.0, 0.5), yaw=np.pi / 2, altitude=ALTITUDE),
    "low_pass": _crossing,
    "upset": control.hover((0.0, 0.0, ALTITUDE)),  # the initial state has a body rate
}
if TYPE_CHECKING:
    Reference = str
else:
    Reference = Literal[tuple(PATHS)]
REFERENCES = {  # as reports call them
    "hover": "hover",
    "figure_eight": "figure-8, 3.5 m/s",
    "fast_figure_eight": "figure-8, 6 m/s",
    "step": "step",
    "low_pass": "low pass",
    "upset": "hover from 6 rad/s",
}


def sampled(controller: Controller, seconds: float) -> Float[np.ndarray, "k n 13"]:
    """Sample all PATHS: a state for each period and the horizon after the last."""
    return np.stack([np.asarray(sample(path, controller, seconds)) for path in PATHS.values()])


def hardware(noise: float, latency: float, rotor_lag: float) -> Hardware:
    """The hardware between controller and vehicle; noise 1 is typical of motion capture and a gyroscope."""
    m, quaternion, speed, rate = SENSOR_NOISE
    return Hardware(latency, rotor_lag, (noise * m, noise * quaternion, noise * speed, noise * rate))
