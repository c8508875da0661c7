"""One RK4 step of a model and its Jacobian, which condensing needs.

The derivative of a Runge–Kutta step is a step of the same method on ẋ = f(x, u), Ṡ = ∂f/∂x S + ∂f/∂u: internal
numerical differentiation (Bock, "Numerical treatment of inverse problems in chemical reaction kinetics", 1981).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.control.rotor_lag import lag_matrix, rotor_speeds, stage_shares, step_of
from hybrid_jax.dynamics.base import AbstractVectorField, jvp_columns, linearize
from hybrid_jax.integrate import rk4_step
from hybrid_jax.rotation import normalise
from hybrid_jax.state import QUATERNION, STATE_SIZE, Input, State


def advance_with_jacobian(
    model: AbstractVectorField, x: State, u: Input, dt: float, unit_quaternion: bool = True
) -> tuple[State, Float[Array, "13 17"]]:
    """`advance`, and its Jacobian in x and u."""
    directions = jnp.eye(len(x) + len(u), dtype=x.dtype)
    dx, du = directions[: len(x)], directions[len(x) :]

    def slopes(both, held):
        value, columns = linearize(model, both[:, 0], held, both[:, 1:], du)
        return jnp.concatenate([value[:, None], columns], axis=1)

    start = jnp.concatenate([x[:, None], dx], axis=1)
    both = rk4_step(slopes, start, u, dt)
    x, columns = both[:, 0], both[:, 1:]
    return jvp_columns(_with_unit_quaternion, (x,), (columns,)) if unit_quaternion else (x, columns)


def condensed(
    model, x: Float[Array, "t 13"], u: Float[Array, "t 4"], slope: Float[Array, "t 4"], dt: float, unit_quaternion: bool
) -> Float[Array, "t 13 n"]:
    """∂(state at the end of each interval) / ∂(all n = 4 t decision variables); `slope` is d u / d variable."""

    def stage(x, u, slope):
        jacobian = advance_with_jacobian(model, x, u, dt, unit_quaternion)[1]
        return jnp.concatenate([jacobian[:, :STATE_SIZE], jacobian[:, STATE_SIZE:] * slope], axis=1)

    def interval(carried, stage):
        jacobian, i = stage
        carried = jnp.tensordot(jacobian[:, :STATE_SIZE], carried, 1)
        carried = jax.lax.dynamic_update_slice(carried, jacobian[:, None, STATE_SIZE:], (0, i, 0))
        return carried, carried

    none, stages = jnp.zeros((STATE_SIZE, *u.shape), x.dtype), jax.vmap(stage)(x, u, slope)
    return jax.lax.scan(interval, none, (stages, jnp.arange(len(u))))[1].reshape(len(u), STATE_SIZE, -1)


def lagged_with_jacobian(
    model: AbstractVectorField, x: State, speeds: Input, command: Input, lag: float, dt: float, unit_quaternion=True
) -> tuple[State, Float[Array, "13 21"]]:
    """The state of `advance_lagged`, and its Jacobian in x, the rotors' speeds before and the command."""
    d, m = len(x), len(speeds)
    directions, one = jnp.eye(d, d + 2 * m, dtype=x.dtype), jnp.eye(m, dtype=x.dtype)
    none = jnp.zeros((m, d), x.dtype)
    inputs = [
        (command + share * (speeds - command), jnp.concatenate([none, share * one, (1 - share) * one], axis=1))
        for share in stage_shares(lag, dt)
    ]

    def slopes(both, held):
        value, columns = linearize(model, both[:, 0], held[0], both[:, 1:], held[1])
        return jnp.concatenate([value[:, None], columns], axis=1)

    both = step_of(slopes, jnp.concatenate([x[:, None], directions], axis=1), inputs, dt)
    x, columns = both[:, 0], both[:, 1:]
    return jvp_columns(_with_unit_quaternion, (x,), (columns,)) if unit_quaternion else (x, columns)


def condensed_lagged(
    model, x: Float[Array, "t 13"], before: Input, commands: Float[Array, "t 4"], lag: float, dt: float, unit_quaternion
) -> Float[Array, "t 13 t 4"]:
    """∂(state at the end of each interval) / ∂(all commands) of rotors that lag; `before`: their speeds at first."""
    d, m = STATE_SIZE, commands.shape[1]
    kept, mixed = (part.astype(x.dtype) for part in lag_matrix(lag, dt, len(commands)))
    speeds = kept[:, None] * before + mixed @ commands

    def stage(x, speeds, command):
        return lagged_with_jacobian(model, x, speeds, command, lag, dt, unit_quaternion)[1]

    def interval(carried, stage):
        jacobian, row, i = stage
        carried = jnp.tensordot(jacobian[:, :d], carried, 1) + jacobian[:, None, d : d + m] * row[:, None]
        carried = carried.at[:, i].add(jacobian[:, d + m :])
        return carried, carried

    none, stages = jnp.zeros((d, *commands.shape), x.dtype), jax.vmap(stage)(x, speeds, commands)
    return jax.lax.scan(interval, none, (stages, jnp.asarray(mixed), jnp.arange(len(commands))))[1]


def advance_lagged(
    model: AbstractVectorField, x: State, speeds: Input, command: Input, lag: float, dt: float, unit_quaternion=True
) -> tuple[State, Input]:
    """State and rotor speeds after dt [s], while the rotors follow a command with a lag: one step of classical RK4."""
    if not lag:
        return advance(model, x, command, dt, unit_quaternion), command
    inputs = [command + share * (speeds - command) for share in stage_shares(lag, dt)]
    x = step_of(model, x, inputs, dt)
    return _with_unit_quaternion(x) if unit_quaternion else x, rotor_speeds(speeds, command, lag, dt)[1]


def advance(model: AbstractVectorField, x: State, u: Input, dt: float, unit_quaternion: bool = True) -> State:
    """The state after dt [s] with u held: one step of classical RK4.

    Args:
        model: ẋ = f(x, u) of a rigid body.
        dt: length of the step [s].
        unit_quaternion: normalise the quaternion afterwards.
    """
    x = rk4_step(model, x, u, dt)
    return _with_unit_quaternion(x) if unit_quaternion else x


def _with_unit_quaternion(x: State) -> State:
    return x.at[QUATERNION].set(normalise(x[QUATERNION]))
