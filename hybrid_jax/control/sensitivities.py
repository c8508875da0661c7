"""One RK4 step of a model under rotors that may lag, and its Jacobian, which condensing needs.

The derivative of a Runge–Kutta step is a step of the same method on ẋ = f(x, u), Ṡ = ∂f/∂x S + ∂f/∂u: internal
numerical differentiation (Bock, "Numerical treatment of inverse problems in chemical reaction kinetics", 1981).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.control.rotor_lag import lag_matrix, lagged_speeds, stage_shares, step_of
from hybrid_jax.dynamics.base import AbstractVectorField, as_field, jvp_columns
from hybrid_jax.integrate import rk4_step
from hybrid_jax.rotation import normalise
from hybrid_jax.state import QUATERNION, STATE_SIZE, Input, State


def advance(model: AbstractVectorField, x: State, u: Input, dt: float, unit_quaternion: bool = True) -> State:
    """The state after dt [s] with u held: one step of classical RK4.

    Args:
        model: ẋ = f(x, u) of a rigid body.
        dt: length of the step [s].
        unit_quaternion: normalise the quaternion afterwards.
    """
    x = rk4_step(model, x, u, dt)
    return _with_unit_quaternion(x) if unit_quaternion else x


def advance_lagged(
    model: AbstractVectorField, x: State, speeds: Input, command: Input, lag: float, dt: float, unit_quaternion=True
) -> tuple[State, Input]:
    """State and rotor speeds after dt [s], while the rotors follow a command with a lag, or at once if that is 0."""
    if not lag:
        return advance(model, x, command, dt, unit_quaternion), command
    inputs = [command + share * (speeds - command) for share in stage_shares(lag, dt)]
    x = step_of(model, x, inputs, dt)
    return _with_unit_quaternion(x) if unit_quaternion else x, lagged_speeds(speeds, command, lag, dt)[1]


def advance_with_jacobian(
    model: AbstractVectorField, x: State, speeds: Input, command: Input, lag: float, dt: float, unit_quaternion=True
) -> tuple[State, Float[Array, "13 n"]]:
    """The state of `advance_lagged`, and its Jacobian in x, the command and, if they lag, the rotors' speeds."""
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
    x, columns = both[:, 0], both[:, 1:]
    return jvp_columns(_with_unit_quaternion, (x,), (columns,)) if unit_quaternion else (x, columns)


def condensed(
    model, x: Float[Array, "t 13"], before: Input, commands: Float[Array, "t 4"], lag: float, dt: float, unit_quaternion
) -> Float[Array, "t 13 t 4"]:
    """∂(state at the end of each interval) / ∂(all commands); `before`: the rotors' speeds at first."""
    d, (t, m) = STATE_SIZE, commands.shape
    kept, mixed = (part.astype(x.dtype) for part in lag_matrix(lag, dt, t))
    speeds = kept[:, None] * before + mixed @ commands

    def stage(x, speeds, command):
        return advance_with_jacobian(model, x, speeds, command, lag, dt, unit_quaternion)[1]

    def interval(carried, stage):
        jacobian, row, i = stage
        carried = jnp.tensordot(jacobian[:, :d], carried, 1)
        if lag:
            carried = carried + jacobian[:, None, d + m :] * row[:, None]
        carried = carried.at[:, i].add(jacobian[:, d : d + m])
        return carried, carried

    none, stages = jnp.zeros((d, t, m), x.dtype), jax.vmap(stage)(x, speeds, commands)
    return jax.lax.scan(interval, none, (stages, jnp.asarray(mixed), jnp.arange(t)))[1]


def _with_unit_quaternion(x: State) -> State:
    return x.at[QUATERNION].set(normalise(x[QUATERNION]))
