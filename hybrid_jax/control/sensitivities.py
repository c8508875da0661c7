"""One RK4 step of a model with rotor lag, and its Jacobian for condensing.

The derivative of a Runge–Kutta step is a step of the same method on ẋ = f(x, u), Ṡ = ∂f/∂x S + ∂f/∂u: internal
numerical differentiation (Bock, "Numerical treatment of inverse problems in chemical reaction kinetics", 1981).
"""

import math
from collections.abc import Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, as_field, jvp_columns
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.integrate import RK4, Derivative, rk4_step, traced_once
from hybrid_jax.vehicle import Input, State


def lagged_speeds(speeds: Input, command: Input, lag: float, dt: float) -> tuple[Input, Input]:
    """Compute the mean and final speeds [rad/s] of rotors that follow a command with τ ẇ = c − w over dt [s].

    Exact for a constant command. Applying the mean over the whole interval is correct for velocities to first order of
    the change; if the interval is as long as the lag, positions and angles need `stage_shares`.

    Args:
        speeds: rotor speeds at the start [rad/s].
        command: constant command over dt [rad/s].
        lag: time constant τ [s]; 0 for none.
        dt: length of the interval [s].
    """
    if not lag:
        return command, command
    kept = math.exp(-dt / lag)
    return command + (speeds - command) * ((1 - kept) * lag / dt), command + (speeds - command) * kept


def stage_shares(lag: float, dt: float) -> tuple[float, float, float]:
    """Return the shares a, b, c of the previous speeds at the start, middle and end of an RK4 step.

    For a chain of integrators with input f(s), 0 ≤ s ≤ 1, RK4 approximates ∫ f by (a + 4 b + c)/6, ∫ (1 − s) f by a/6 +
    b/3 and ½ ∫ (1 − s)² f by (a + b)/12. These shares make all three exact for f = exp(−s dt/τ). The true values 1,
    exp(−dt/2τ), exp(−dt/τ) do so only if the lag is long compared with dt.
    """
    rate = dt / lag
    kept = math.exp(-rate)
    if rate < 0.01:  # the differences below would cancel
        return 1.0, math.exp(-rate / 2), kept
    first = (1 - kept) / rate
    second = (1 - first) / rate
    third = (0.5 - second) / rate
    return 24 * third - 6 * second, 6 * second - 12 * third, 6 * first - 18 * second + 24 * third


def step_of(derivative: Derivative, x: State, inputs: Sequence[Any], dt: float) -> State:
    """Compute one RK4 step over dt [s] with these inputs at its start, middle and end."""
    evaluate = traced_once(derivative, x)
    term = diffrax.ODETerm(lambda t, x, _: evaluate(x, inputs[round(2 * float(t) / dt)]))
    return RK4().step(term, 0.0, dt, x, None, None, made_jump=False)[0]


def advance(model: AbstractVectorField, x: State, u: Input, dt: float) -> State:
    """Compute the state after dt [s] with constant u by one step of classical RK4, with a unit quaternion.

    Args:
        model: a rigid body's ẋ = f(x, u).
        dt: length of the step [s].
    """
    return RIGID_BODY_SPACE.normalise(rk4_step(model, x, u, dt))


def advance_lagged(
    model: AbstractVectorField, x: State, speeds: Input, command: Input, lag: float, dt: float
) -> tuple[State, Input]:
    """Compute state and rotor speeds after dt [s]; rotors follow the command with a lag, or at once if it is 0."""
    if not lag:
        return advance(model, x, command, dt), command
    inputs = [command + share * (speeds - command) for share in stage_shares(lag, dt)]
    return RIGID_BODY_SPACE.normalise(step_of(model, x, inputs, dt)), lagged_speeds(speeds, command, lag, dt)[1]


def advance_with_jacobian(
    model: AbstractVectorField, x: State, speeds: Input, command: Input, lag: float, dt: float
) -> tuple[State, Float[Array, "13 n"]]:
    """Return the state of `advance_lagged` and its Jacobian in x, the command and (with lag) the rotor speeds."""
    d, m = len(x), len(command)
    one, none = jnp.eye(m, dtype=x.dtype), jnp.zeros((m, d), x.dtype)
    if lag:
        inputs = [
            (command + share * (speeds - command), jnp.concatenate([none, (1 - share) * one, share * one], axis=1))
            for share in stage_shares(lag, dt)
        ]
    else:
        inputs = [(command, jnp.concatenate([none, one], axis=1))] * 3

    def slopes(both, held):
        value, columns = as_field(model).linearize(both[:, 0], held[0], both[:, 1:], held[1])
        return jnp.concatenate([value[:, None], columns], axis=1)

    directions = jnp.eye(d, inputs[0][1].shape[1], dtype=x.dtype)
    both = step_of(slopes, jnp.concatenate([x[:, None], directions], axis=1), inputs, dt)
    return jvp_columns(RIGID_BODY_SPACE.normalise, (both[:, 0],), (both[:, 1:],))


def condensed(
    model, x: Float[Array, "t 13"], before: Input, commands: Float[Array, "t 4"], lag: float, dt: float
) -> Float[Array, "t 13 t 4"]:
    """Return ∂(state at the end of each interval) / ∂(all commands); `before` are the initial rotor speeds."""
    d, (t, m) = x.shape[1], commands.shape
    share, k = math.exp(-dt / lag) if lag else 0.0, np.arange(t)  # of the speeds that an interval keeps
    mixed = np.tril((1 - share) * share ** np.maximum(k[:, None] - k - 1, 0), -1).astype(x.dtype)
    speeds = (share**k).astype(x.dtype)[:, None] * before + mixed @ commands

    def stage(x, speeds, command):
        return advance_with_jacobian(model, x, speeds, command, lag, dt)[1]

    def interval(carried, stage):
        jacobian, row, i = stage
        carried = jnp.tensordot(jacobian[:, :d], carried, 1)
        if lag:
            carried = carried + jacobian[:, None, d + m :] * row[:, None]
        carried = carried.at[:, i].add(jacobian[:, d : d + m])
        return carried, carried

    none, stages = jnp.zeros((d, t, m), x.dtype), jax.vmap(stage)(x, speeds, commands)
    return jax.lax.scan(interval, none, (stages, jnp.asarray(mixed), jnp.arange(t)))[1]
