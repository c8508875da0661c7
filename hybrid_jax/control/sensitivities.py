"""One step of a model, and how it answers to small changes: what condensing needs of a vector field.

The derivative of a Runge–Kutta step is a step of the same method of ẋ = f(x, u), Ṡ = ∂f/∂x S + ∂f/∂u: internal
numerical differentiation (Bock, "Numerical treatment of inverse problems in chemical reaction kinetics", 1981). So a
field is asked for its own derivative at the stages, and a network answers by one product of its matrices, in which a
hidden layer of hundreds of units is gone before any of the 17 columns of S is met.
"""

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, jvp_columns, linearize
from hybrid_jax.integrate import RK4
from hybrid_jax.rotation import normalise
from hybrid_jax.state import QUATERNION, Input, State


def advanced(
    model: AbstractVectorField, x: State, u: Input, dt: float, unit_quaternion: bool = True
) -> tuple[State, Float[Array, "13 17"]]:
    """`advance`, and its Jacobian (13, 17) in x and u."""
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
