"""Predict the least-squares covariance of the parameters for a planned trajectory."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.estimation.least_squares import Solver, ravel_parameters
from hybrid_jax.estimation.normal_equations import inverse
from hybrid_jax.integrate import compact, rollout


class Information(NamedTuple):
    """Sums over all windows, of errors over the noise's standard deviation; J = ∂x̂/∂θ_p."""

    gram: Float[Array, "p p"]  # JᵀJ, the Gauss–Newton information if the first samples were exact
    noise: Float[Array, "p p"]  # the covariance of Jᵀ(x − x̂), with the noise of first samples

    def covariance(self, free: Bool[Array, " p"]) -> Float[Array, "p p"]:
        """The covariance of the free parameters by least squares, infinite if not identifiable; zero for the others."""
        both = free & free[:, None]
        bread, told, _ = inverse(jnp.where(both, self.gram, jnp.diag(jnp.where(free, 0.0, 1.0))))
        return bread @ jnp.where(both, self.noise, 0.0) @ bread + jnp.diag(jnp.where(told, 0.0, jnp.inf))


def information_of(
    field: AbstractVectorField,
    x: Float[Array, "n+1 d"],
    u: Float[Array, "n m"],
    dt: float,
    steps: int,
    noise: Float[Array, " d"],
    solver: Solver = None,
) -> Information:
    """Return the information in true states x every `dt` [s], cut into windows of `steps` intervals.

    Each window is a rollout from its first sample, whose noise acts on the whole window and on the previous one.
    """
    count = len(u) // steps
    starts, inputs = x[: count * steps : steps], u[: count * steps].reshape(count, steps, -1)
    theta, unravel = ravel_parameters(field)

    def one(x0, u):
        def predicted(theta, start):
            return rollout(unravel(theta), x0 + noise * start, u, dt, compact(solver)) / noise

        return jax.jacfwd(predicted, argnums=(0, 1))(theta, jnp.zeros_like(x0))

    effects, of_start = jax.vmap(one)(starts, inputs)  # (n, t, d, p) and (n, t, d, d)
    first = -jnp.einsum("ntdp,ntde->nep", effects, of_start)  # what the noise of each first sample does to Jᵀ(x − x̂)
    zero = jnp.zeros_like(first[:1])
    shared = jnp.concatenate([zero, effects[:, -1]]) + jnp.concatenate([first, zero])
    alone = effects[:, :-1].reshape(-1, theta.size)
    shared = shared.reshape(-1, theta.size)
    return Information(jnp.einsum("ntdp,ntdq->pq", effects, effects), alone.T @ alone + shared.T @ shared)
