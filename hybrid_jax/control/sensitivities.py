"""One RK4 step of a model and its Jacobian, which condensing needs.

The derivative of a Runge–Kutta step is a step of the same method on ẋ = f(x, u), Ṡ = ∂f/∂x S + ∂f/∂u: internal
numerical differentiation (Bock, "Numerical treatment of inverse problems in chemical reaction kinetics", 1981). The
field provides its own derivative at each stage (`linearize`), which for a network is one product of its matrices.
"""

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, jvp_columns, linearize
from hybrid_jax.integrate import RK4
from hybrid_jax.rotation import normalise
from hybrid_jax.state import QUATERNION, Input, State


def advance_with_jacobian(
    model: AbstractVectorField, x: State, u: Input, dt: float, unit_quaternion: bool = True
) -> tuple[State, Float[Array, "13 17"]]:
    """`advance`, and its Jacobian in x and u."""
    directions = jnp.eye(len(x) + len(u), dtype=x.dtype)
    dx, du = directions[: len(x)], directions[len(x) :]

    def slopes(t, both, held):
        value, columns = linearize(model, both[:, 0], held, both[:, 1:], du)
        return jnp.concatenate([value[:, None], columns], axis=1)

    start = jnp.concatenate([x[:, None], dx], axis=1)
    both = RK4().step(diffrax.ODETerm(slopes), 0.0, dt, start, u, None, made_jump=False)[0]
    x, columns = both[:, 0], both[:, 1:]
    return jvp_columns(with_unit_quaternion, (x,), (columns,)) if unit_quaternion else (x, columns)


def advance(model: AbstractVectorField, x: State, u: Input, dt: float, unit_quaternion: bool = True) -> State:
    """The state after dt [s] with u held: one step of classical RK4."""
    term = diffrax.ODETerm(lambda t, x, held: model(x, held))
    x = RK4().step(term, 0.0, dt, x, u, None, made_jump=False)[0]
    return with_unit_quaternion(x) if unit_quaternion else x


def with_unit_quaternion(x: State) -> State:
    """The state with its quaternion normalised."""
    return x.at[QUATERNION].set(normalise(x[QUATERNION]))
