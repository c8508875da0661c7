"""Rotors that follow their commands with a lag of first order."""

import math
from collections.abc import Sequence
from typing import Any

import diffrax
import numpy as np

from hybrid_jax.integrate import RK4, Derivative, traced_once
from hybrid_jax.state import Input, State


def lagged_speeds(speeds: Input, command: Input, lag: float, dt: float) -> tuple[Input, Input]:
    """The mean speeds [rad/s] over dt [s] of rotors that follow a command with a lag, τ ẇ = c − w, and those after it.

    Exact for a command that is held. To take the mean as speeds that are held is right for velocities, to first order
    of the change; over an interval as long as the lag, positions and angles need `stage_shares`.

    Args:
        speeds: of the rotors at the start [rad/s].
        command: held over dt [rad/s].
        lag: τ, time constant [s]; 0 for none.
        dt: time that passes [s].
    """
    if not lag:
        return command, command
    kept = math.exp(-dt / lag)
    return command + (speeds - command) * ((1 - kept) * lag / dt), command + (speeds - command) * kept


def stage_shares(lag: float, dt: float) -> tuple[float, float, float]:
    """Shares a, b, c of the speeds before an interval that rotors have at the start, middle and end of it, for RK4.

    A step of RK4 of a chain of integrators whose input is f(s), 0 ≤ s ≤ 1, finds ∫ f as (a + 4 b + c)/6, ∫ (1 − s) f
    as a/6 + b/3 and ½ ∫ (1 − s)² f as (a + b)/12. These shares make all three right for f = exp(−s dt/τ): as a force
    moves velocity and position, and a torque rates, attitude and velocity. True shares 1, exp(−dt/2τ), exp(−dt/τ) do
    so for a lag that is long beside dt alone.
    """
    rate = dt / lag
    kept = math.exp(-rate)
    if rate < 0.01:  # the differences below lose their digits
        return 1.0, math.exp(-rate / 2), kept
    first = (1 - kept) / rate
    second = (1 - first) / rate
    third = (0.5 - second) / rate
    return 24 * third - 6 * second, 6 * second - 12 * third, 6 * first - 18 * second + 24 * third


def lag_matrix(lag: float, dt: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """What the speeds before the first of some intervals (t), and the commands of all (t, t), add to those before each
    interval."""
    kept, k = math.exp(-dt / lag) if lag else 0.0, np.arange(steps)
    since = np.maximum(k[:, None] - k - 1, 0)
    return kept**k, np.tril((1 - kept) * kept**since, -1)


def step_of(derivative: Derivative, x: State, inputs: Sequence[Any], dt: float) -> State:
    """One step of RK4 over dt [s] with these inputs at its start, middle and end."""
    evaluate = traced_once(derivative, x)
    term = diffrax.ODETerm(lambda t, x, _: evaluate(x, inputs[round(2 * float(t) / dt)]))
    return RK4().step(term, 0.0, dt, x, None, None, made_jump=False)[0]
