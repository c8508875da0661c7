"""x⁺ = F(x, u): one step of a field with its input held."""

import diffrax
from jaxtyping import Array, Float

from hybrid_jax.integrate import RK4, Derivative


def one_step(
    derivative: Derivative, x: Float[Array, " d *b"], u: Float[Array, " m *b"], dt: float
) -> Float[Array, " d *b"]:
    """The state after dt [s]: one step of the library's RK4, as in an interval of `rollout`."""
    term = diffrax.ODETerm(lambda t, x, held: derivative(x, held))
    return RK4().step(term, 0.0, dt, x, u, None, made_jump=False)[0]
