"""Rotors that follow their commands with a lag of first order."""

import math

import numpy as np

from hybrid_jax.state import Input


def rotor_speeds(speeds: Input, command: Input, lag: float, dt: float) -> tuple[Input, Input]:
    """The mean speeds [rad/s] over dt [s] of rotors that follow a command with a lag, τ ẇ = c − w, and those after it.

    Exact for a command that is held. The library's models take the mean as speeds that are held, which is right to
    first order in dt / τ of the change.
    """
    if not lag:
        return command, command
    kept = math.exp(-dt / lag)
    return command + (speeds - command) * ((1 - kept) * lag / dt), command + (speeds - command) * kept


def lag_matrix(lag: float, dt: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """What the speeds before the first of some intervals (t), and the commands of all (t, t), add to each mean."""
    kept, k = math.exp(-dt / lag), np.arange(steps)
    left = (1 - kept) * lag / dt  # of the speeds at the start of an interval, in its mean
    since = np.maximum(k[:, None] - k - 1, 0)
    return left * kept**k, np.tril(left * (1 - kept) * kept**since, -1) + (1 - left) * np.eye(steps)
