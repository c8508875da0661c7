"""A trajectory and its derivatives with respect to all parameters of a field.

The derivative of an explicit Runge–Kutta method is the same method on ẋ = f(x, θ), Ṡ = ∂f/∂x S + ∂f/∂θ: internal
numerical differentiation (Bock, "Numerical treatment of inverse problems in chemical reaction kinetics", 1981). Values
shared by all parameters, for example the slopes of a network at each point of a grid, are computed once.
"""

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, as_field, ravel_learned
from hybrid_jax.integrate import RK4, Solver, integrate

Columns = Float[Array, "t d p"]  # of the states at the end of each interval, in the order of the leaves of the field


def with_sensitivities(
    field: AbstractVectorField, x0: Float[Array, " d"], u: Float[Array, "t m"], dt: float, solver: Solver
) -> tuple[Float[Array, "t d"], Columns]:
    """The states of `integrate`, and their derivatives with respect to each learned number."""
    theta, at = ravel_learned(field)
    if not isinstance(solver, RK4 | diffrax.AbstractERK):
        states, push = jax.linearize(lambda theta: integrate(at(theta), x0, u, dt, solver), theta)
        return states, jnp.moveaxis(jax.lax.map(push, jnp.eye(theta.size, dtype=theta.dtype)), 0, -1)

    def slopes(both: Float[Array, "d 1+p"], held):
        x, columns = both[:, 0], both[:, 1:]
        value, moved = as_field(field).linearize(x, held, columns, jnp.zeros((len(held), theta.size), held.dtype))
        return jnp.concatenate([value[:, None], moved + as_field(field).parameter_columns(x, held)], axis=1)

    start = jnp.concatenate([x0[:, None], jnp.zeros((len(x0), theta.size), x0.dtype)], axis=1)
    both = integrate(slopes, start, u, dt, solver)
    return both[..., 0], both[..., 1:]
