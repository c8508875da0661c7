"""Measure how far a flight lies outside the range of the training flight."""

from collections.abc import Mapping

import numpy as np

from hybrid_jax.state_space import StateSpace
from hybrid_jax.trajectories import Trajectories

RANGE = 0.01, 0.99  # quantiles of the training samples
WARN = 0.1  # share of samples outside of it that is worth a warning

Features = Mapping[str, np.ndarray]


def features_of(windows: Trajectories, space: StateSpace) -> Features:
    x, u = np.asarray(windows.x), np.asarray(windows.u)
    x, u = (part.reshape(x.shape[0] * x.shape[1], part.shape[-1]) for part in (x, u))
    return space.features(x, u)


def shares_outside(known: Features, asked: Features) -> dict[str, float]:
    """By quantity, the fraction of samples outside the 1 to 99 % range of the known ones."""
    ends = {name: np.nanquantile(values, RANGE) for name, values in known.items()}
    return {name: float(np.mean((asked[name] < low) | (asked[name] > high))) for name, (low, high) in ends.items()}
