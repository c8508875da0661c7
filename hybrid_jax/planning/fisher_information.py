"""Predict the least-squares covariance of the parameters for a planned trajectory."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, as_field
from hybrid_jax.dynamics.hidden import DisturbanceModel
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.normal_equations import inverse, inverses
from hybrid_jax.integrate import compact, rollout
from hybrid_jax.vehicle import SENSOR_NOISE, STATE_SIZE


class Information(NamedTuple):
    """Sums over all windows, with errors divided by the noise's standard deviation; J = ∂x̂/∂θ_p."""

    gram: Float[Array, "p p"]  # JᵀJ, the Gauss–Newton information if the first samples were exact
    noise: Float[Array, "p p"]  # the covariance of Jᵀ(x − x̂), with the noise of first samples and a past's disturbance

    def covariance(self, free: Bool[Array, " p"]) -> Float[Array, "p p"]:
        """Return the least-squares covariance of the free parameters, infinite if not identifiable; else zero."""
        both = free & free[:, None]
        bread, identified, _ = inverse(jnp.where(both, self.gram, jnp.diag(jnp.where(free, 0.0, 1.0))))
        return bread @ jnp.where(both, self.noise, 0.0) @ bread + jnp.diag(jnp.where(identified, 0.0, jnp.inf))


def information_of(
    field: AbstractVectorField,
    x: Float[Array, "n+1 d"],
    u: Float[Array, "n m"],
    dt: float,
    steps: int,
    noise: Float[Array, " s"],
    past: DisturbanceModel | None = None,
) -> Information:
    """Return the information of true states x, one every `dt` [s], cut into windows of `steps` intervals.

    Each window is a rollout from its first sample, whose noise acts on the whole window and on the previous one. Only
    the first s states are measured; the others are unknown at the start of each window. The disturbance is as large as
    in the data of `past`, and forgotten within its time constants.
    """
    count, measured = len(u) // steps, len(noise)
    starts, inputs = x[: count * steps : steps], u[: count * steps].reshape(count, steps, -1)
    theta, unravel = ravel_parameters(field)
    sizes = jnp.zeros(0) if past is None else past.sizes[: len(past.weights)]

    def one(x0, u):
        def predicted(theta, start, e):
            own = unravel(theta)
            own = own if past is None else DisturbanceModel(own, e[:, None], jnp.ones(1), (), ())  # constant
            moved = x0 + jnp.concatenate([noise, jnp.ones(len(x0) - measured)]) * start
            return rollout(own, moved, u, dt, compact(None))[:, :measured] / noise

        return jax.jacfwd(predicted, argnums=(0, 1, 2))(theta, jnp.zeros_like(x0), jnp.zeros_like(sizes))

    # (n, t, s, p), (n, t, s, d) and (n, t, s, e)
    effects, of_start, disturbed = jax.vmap(one)(starts, inputs)
    if as_field(field).hidden:  # effects that hidden states can also have do not count
        other = of_start[..., measured:]
        back = inverses(jnp.einsum("ntdh,ntdk->nhk", other, other)).matrix
        effects = effects - jnp.einsum("ntdh,nhk,nsek,nsep->ntdp", other, back, other, effects)
    first = -jnp.einsum("ntdp,ntde->nep", effects, of_start[..., :measured])  # of the noise of each first sample
    zero = jnp.zeros_like(first[:1])
    shared = jnp.concatenate([zero, effects[:, -1]]) + jnp.concatenate([first, zero])
    alone = effects[:, :-1].reshape(-1, theta.size)
    shared = shared.reshape(-1, theta.size)
    noisy = alone.T @ alone + shared.T @ shared
    if past is not None:
        pushed = jnp.einsum("ntdp,ntde->npe", effects, disturbed) * sizes
        apart = dt * steps * jnp.abs(jnp.arange(count)[:, None] - jnp.arange(count))
        alike = jnp.mean(jnp.stack([jnp.exp(-apart / tau) for tau in past.time_constants]), axis=0)
        noisy = noisy + jnp.einsum("npe,nm,mqe->pq", pushed, alike, pushed)
    return Information(jnp.einsum("ntdp,ntdq->pq", effects, effects), noisy)


def noise_of(noise: Sequence[float] | None, states: int) -> Float[np.ndarray, " s"]:
    """Return the noise of each measured state, by default of motion capture; ValueError for other numbers."""
    if noise is None:
        if states != STATE_SIZE:
            raise ValueError(f"noise must be given: the standard deviation of each of {states} measured states")
        return np.repeat(np.array(SENSOR_NOISE, np.float32), (3, 4, 3, 3))
    sizes = np.asarray(checks.finite("noise", checks.real_array("noise", noise)), np.float32)
    if sizes.shape != (states,) or not (sizes > 0).all():
        raise ValueError(f"noise must be {states} positive numbers, got {checks.short_repr(noise)}")
    return sizes
