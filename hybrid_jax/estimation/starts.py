"""Remove the noise of measured initial states from windows' errors (errors in variables; Fuller 1987).

Each window starts at a smoothed state, and the effect of this state's error is projected out of the window's errors.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.batches import in_chunks, solve
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.by_product import fixed_residual
from hybrid_jax.estimation.least_squares import TOGETHER, Scale, Solver
from hybrid_jax.integrate import compact, rollout
from hybrid_jax.trajectories import Trajectories

ORDER = 3  # of the differences
MOST = 32  # states: with more, for example on a grid, the measured start is used


class Starts(NamedTuple):
    """Estimates of each window's start."""

    x0: Float[Array, "*n d"]  # the smoothed start
    jump: Float[Array, "*n d"]  # measured minus smoothed start, over scale
    effect: Float[Array, "*n t d d"]  # derivative of the window's states with respect to the start, both over scale
    inverse: Float[Array, "*n d d"]  # inverse of the start's normal equations
    # Squared weight of the measured start relative to a prediction; it is large if the field's errors are larger than
    # the noise, for example after a large change.
    trust: Float[Array, "*n"]


def smoothed(
    field: AbstractVectorField, windows: Trajectories, solver: Solver, scale: Scale
) -> tuple[Starts | None, Float[Array, ""]]:
    """Return smoothed starts from the field's predictions, and the noise of one number over scale.

    The noise is estimated from successive differences of the errors (von Neumann 1941), since errors of the field grow
    slowly. It is zero, with no starts, if the state is too large.
    """
    t, d = windows.x.shape[1:]
    order = min(ORDER, t)
    if d > MOST:
        return None, jnp.zeros(())
    unit = jnp.ones(d) if scale is None else scale
    counts = jnp.isfinite(unit)
    unit, fixed = jnp.where(counts, unit, 1).astype(windows.x0.dtype), fixed_residual(field)

    def one(window: Trajectories):
        def predicted(start):
            return 2 * (rollout(fixed, window.x0 + unit * start, window.u, window.dt, compact(solver)),)

        effect, x = jax.jacfwd(predicted, has_aux=True)(jnp.zeros_like(window.x0))
        seen = counts & ~jnp.isnan(window.x)
        effect = effect / unit[:, None] * counts * seen[..., None]
        r = jnp.where(seen, (window.x - x) / unit, 0).astype(x.dtype)
        rows = jnp.concatenate([jnp.eye(d, dtype=r.dtype)[None], effect])
        errors = jnp.concatenate([jnp.zeros_like(r[:1]), r])
        gaps = jnp.diff(jnp.concatenate([jnp.zeros_like(r[:1]), 0 * window.x]), n=order, axis=0)  # NaN at a missing one
        rough = jnp.where(jnp.isnan(gaps), 0, jnp.square(jnp.diff(errors, n=order, axis=0)))
        return effect, r, _unexplained(rows, errors), jnp.sum(rough), jnp.sum(~jnp.isnan(gaps))

    effect, r, left, noise, successive = in_chunks(jax.vmap(one), windows, TOGETHER)
    successive, noise = jnp.sum(successive), jnp.sum(noise) / math.comb(2 * order, order)
    left = jnp.sum(left) / jnp.sum(~jnp.isnan(windows.x))
    noise = jnp.where(successive > 0, noise / jnp.maximum(successive, 1), left)  # too few samples for differences
    trust = jnp.clip(left / jnp.maximum(noise, 1e-12), 1.0, 1e6)

    def start(each):
        effect, r = each
        one, flat = jnp.eye(d, dtype=r.dtype), effect.reshape(-1, d)
        inverse = solve(trust.astype(r.dtype) * one + flat.T @ flat, one)
        return inverse @ (flat.T @ r.ravel()), inverse

    change, inverse = jax.lax.map(start, (effect, r))
    many = jnp.broadcast_to(trust, len(windows))
    return Starts(windows.x0 + unit * change, -change, effect, inverse, many), noise


def _unexplained(rows: Float[Array, "t d k"], r: Float[Array, "t d"]) -> Float[Array, ""]:
    flat = rows.reshape(-1, rows.shape[-1])
    gram = flat.T @ flat
    damped = gram + 1e-6 * jnp.diag(jnp.diagonal(gram) + 1e-6)
    return jnp.sum(jnp.square(r.ravel() - flat @ solve(damped, flat.T @ r.ravel())))


def from_starts(windows: Trajectories, starts: Starts | None) -> tuple[Trajectories, Callable[[Array], Array]]:
    """Return the windows from smoothed starts, and the projection of their errors; unchanged without starts."""
    if starts is None:
        return windows, lambda errors: errors
    return replace(windows, x0=starts.x0), partial(projected, starts)


def projected(starts: Starts, errors: Float[Array, "n t d"]) -> Float[Array, "n 1+t d"]:
    """Project the effect of another start out of the errors of the starts and of the predictions."""

    def one(start: Starts, r):
        change = start.inverse @ (start.trust * start.jump + jnp.einsum("tij,ti->j", start.effect, r))
        return jnp.concatenate([jnp.sqrt(start.trust) * (start.jump - change)[None], r - start.effect @ change])

    return jax.vmap(one)(starts, errors)
