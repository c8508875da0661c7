"""Least squares for shared parameters θ and for each piece's own unknowns, by Schur complements (Bock 1983).

A piece is a window or a record.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax.batches import solve
from hybrid_jax.estimation.levenberg_marquardt import DAMPING, begin, in_python, minimise, move_of_equations
from hybrid_jax.estimation.normal_equations import RANK, NormalEquations, inverse, inverses
from hybrid_jax.status import Status

TRACE = 1e-2  # smallest share of a direction that is named


class Reduced(NamedTuple):
    """The normal equations of θ after elimination; a step Δθ moves the own unknowns by −(offset + slope Δθ)."""

    equations: NormalEquations
    offset: Float[Array, "n s"]
    slope: Float[Array, "n s p"]


@partial(jax.jit, static_argnums=1)
def reduced(equations: NormalEquations, p: int, damping: Float[Array, ""] | float = 0.0) -> Reduced:
    """Eliminate each piece's own unknowns; `damping` is relative to the diagonal of its normal equations."""
    gram, score, square = equations
    size = jnp.sqrt(jnp.diagonal(gram[:, p:, p:], axis1=1, axis2=2))
    unit = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 0)[..., None]
    held = gram[:, p:, p:] * unit * unit.swapaxes(1, 2) + jax.vmap(jnp.diag)(jnp.where(size > 0, damping, 1.0))
    right = jnp.concatenate([score[:, p:, None], gram[:, p:, :p]], axis=2)
    found = unit * jax.vmap(solve)(held, unit * right)
    across = jnp.einsum("nps,nsq->npq", gram[:, :p, p:], found)
    left = NormalEquations(gram[:, :p, :p] - across[..., 1:], score[:, :p] - across[..., 0], square)
    return Reduced(left, found[..., 0], found[..., 1:])


@partial(jax.jit, static_argnums=1)
def move(equations: NormalEquations, p: int, damping: Float[Array, ""], free: Bool[Array, " p"], least: float, most):
    """Return a step of θ of at most `most` (p), the steps of the own unknowns (n, s), and the expected decrease."""
    (gram, score, _), offset, slope = reduced(equations, p, damping)
    gram, score = jnp.sum(gram, axis=0), jnp.sum(score, axis=0)
    seen = free & (jnp.diagonal(gram) > least)
    step, expected = jnp.zeros(p), jnp.zeros(())
    if p:
        both, pull = jnp.where(seen[:, None] & seen, gram, 0), jnp.where(seen, score, 0)
        step, expected = move_of_equations(both, pull, damping)
        near = jnp.clip(step, -most, most)
        far = near != step
        # The others move to where they are best beside the parameters that stop on the way.
        rest = jnp.where(~far[:, None] & ~far, both, 0), jnp.where(far, 0, pull + both @ jnp.where(far, near, 0))
        short = jnp.where(far, near, jnp.clip(move_of_equations(*rest, damping)[0], -most, most))
        step = jnp.where(jnp.any(far), short, step)
        expected = jnp.where(jnp.any(far), -short @ (2 * pull + both @ short), expected)
    own = -offset - jnp.einsum("nsp,p->ns", slope, step)
    weight = jnp.diagonal(equations.gram[:, p:, p:], axis1=1, axis2=2)
    return step, own, expected + jnp.sum(equations.score[:, p:] * offset) + damping * jnp.sum(weight * own**2)


class End(NamedTuple):
    """The end of a search: θ, the unknowns of each piece, and their normal equations."""

    theta: Float[Array, " p"]
    own: Float[Array, "n s"]
    equations: NormalEquations
    steps: int
    status: Status


def descend(
    equations: Callable[[Any, Any], NormalEquations],
    theta: Float[Array, " p"],
    own: Float[Array, "n s"],
    *,
    free: Bool[Array | np.ndarray, " p"] | None = None,
    least: float = 0.0,
    most: Float[np.ndarray, " p"] | float = np.inf,
    max_steps: int = 50,
    tolerance: float = 1e-6,
    damping: float = DAMPING,
    cost: Callable[[Any, Any], Any] | None = None,
) -> End:
    """Minimise the cost over θ and the pieces' own unknowns, by Levenberg–Marquardt.

    Parameters that are not `free`, or with information of at most `least` after elimination, do not change.
    No step changes a parameter by more than `most`. If `cost` is given, because it is cheaper, equations are only
    computed where it is lower.
    """
    moves = jnp.ones(len(theta), bool) if free is None else jnp.asarray(free)

    def evaluate(point, state):
        if cost is not None and not (value := cost(*point)) < state.cost:
            return value, state.best
        found = equations(*point)
        return jnp.sum(found.square), (point, found)

    def aim(best, damping):
        (theta, own), found = best
        step, change, expected = move(found, len(theta), damping, moves, least, most)
        return (theta + step, own + change), expected, 0.0

    point, nothing = (theta, own), NormalEquations(*3 * (jnp.zeros(()),))
    end = minimise(evaluate, aim, begin(point, (point, nothing), damping), max_steps, tolerance, in_python)
    (theta, own), found = end.best
    return End(theta, own, found, int(end.steps), Status(int(end.status)))


def undetermined(gram: Float[np.ndarray, "k k"], names: Sequence[str]) -> list[str]:
    """Return the directions that change no error by more than rounding, for example "0.71 a - 0.71 b"."""
    if not np.isfinite(gram).all():  # the search diverged
        return []
    size = np.sqrt(np.maximum(np.diagonal(gram), 0.0))
    unit = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(gram / unit / unit[:, None])
    lines = []
    for along in (vectors / unit[:, None]).T[values <= RANK * len(gram) * np.finfo(float).eps]:
        share = along / np.linalg.norm(along) * np.sign(along[np.argmax(np.abs(along) > TRACE * np.abs(along).max())])
        terms = [f"{each:.2g} {name}" for each, name in zip(share, names, strict=True) if abs(each) > TRACE]
        lines.append(" + ".join(terms).replace("+ -", "- ").removeprefix("1 "))
    return lines


def covariance(
    equations: NormalEquations, p: int, meat: Float[np.ndarray, "n q q"] | None = None
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "n s"]]:
    """Return the covariance of θ, and the variances of the own unknowns; infinite if not identifiable.

    `meat` is the covariance of each piece's score (a sandwich; White 1980), by default its Gram matrix.
    """
    gram = np.asarray(equations.gram)
    meat = gram if meat is None else meat
    own = inverses(jnp.asarray(gram[:, p:, p:]))
    back, own_identified = np.asarray(own.matrix), np.asarray(own.identified)
    slope = back @ gram[:, p:, :p]
    theta, identified = np.zeros((p, p)), np.ones(p, bool)
    if p:
        found = inverse(jnp.asarray((gram[:, :p, :p] - gram[:, :p, p:] @ slope).sum(axis=0)))
        theta, identified = np.asarray(found.matrix), np.asarray(found.identified)
    through = np.concatenate([np.broadcast_to(np.eye(p), (len(gram), p, p)), -slope], axis=1)
    half = theta @ through.swapaxes(1, 2) @ meat  # (n, p, q)
    cov = (half @ through).sum(axis=0) @ theta
    identified = identified & (np.diagonal(cov) >= 0)  # few pieces may give a negative variance
    cov = np.where(identified[:, None] & identified, cov, 0.0)
    across = np.einsum("nsp,npt,nts->ns", slope, half[..., p:], back)
    variance = np.einsum("nsp,pq,nsq->ns", slope, cov, slope) - 2 * across
    variance += np.einsum("nst,ntu,nus->ns", back, meat[:, p:, p:], back)
    size = np.sqrt(np.maximum(np.diagonal(gram, axis1=1, axis2=2), 0.0))
    total = np.sqrt((size[:, :p] ** 2).sum(axis=0))
    leak = np.abs(slope[..., ~identified]) * size[:, p:, None] / np.where(total > 0, total, 1.0)[~identified]
    lost = ~own_identified | (leak > np.sqrt(np.finfo(float).eps)).any(axis=2)
    return cov + np.diag(np.where(identified, 0.0, np.inf)), np.where(lost, np.inf, np.maximum(variance, 0.0))
