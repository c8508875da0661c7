"""Choose the change by Bayes factors (Kass and Raftery 1995) from a quadratic form around one fit of everything.

The prior of a change is its plausible size (`Plausible`) plus the apparent change on the source's own motion, since a
source is not exact. A change is chosen only on strong evidence.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax.adaptation.plausible import free_parameters, rivals
from hybrid_jax.adaptation.selection import BLOCKS, TINY, Fit, Unchanged, blocks_of, without_others
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.normal_equations import inverse
from hybrid_jax.runtime import UNOPTIMISED, jit_by_size

STRONG = 20.0  # odds of a change over no change that are strong evidence (Kass and Raftery 1995)
FAR = 3.0  # times its plausible size: a parameter that changes by more probably imitates another change


class Posterior(NamedTuple):
    """The posterior of c candidates."""

    theta: Float[Array, "c p"]  # to first order
    probability: Float[Array, " c"]  # of each change
    naive: Float[Array, " c"]  # the same probability if the source had no errors
    taken: Int[Array, ""]  # index of the chosen candidate
    sizes: Float[Array, " p"]  # the prior for a fit that assumes the variance of the noise, not the dispersion


def posterior(around: Fit, every: Fit, start, free, sizes, apparent: Float[Array, " p"]) -> Posterior:
    """Compare candidates by the squared errors around one fit; `sizes` and `apparent` are the prior of the changes."""
    variance = dispersion(every, sizes)  # what remains if everything may change
    explained = partial(_explained, around, start, sizes, variance)
    free = jnp.tile(jnp.asarray(free) & around.seen, (2, 1))
    of_source = jnp.where(jnp.arange(len(free))[:, None] < len(free) // 2, apparent, 0.0)
    move, evidence = (jnp.split(each, 2) for each in jax.lax.map(lambda own: explained(*own), (free, of_source)))
    evidence, naive = (jnp.where(jnp.isfinite(each), each, -jnp.inf).at[0].max(-1e30) for each in evidence)
    taken = jnp.where(jnp.max(evidence) > evidence[0] + np.log(STRONG), jnp.argmax(evidence), 0)
    held = sizes * jnp.sqrt(every.noise / variance)
    return Posterior(start + jnp.nan_to_num(move[0]), jax.nn.softmax(evidence), jax.nn.softmax(naive), taken, held)


@jit_by_size(UNOPTIMISED)
def rival(larger, every: Fit, chosen: Posterior) -> tuple[Int[Array, ""], Float[Array, " p"], Bool[Array, "2 p"]]:
    """Return the change that the chosen one may be mistaken for, see `rivals`, and what `to_fit`.

    A wind acts almost like a force near the fit that all changes are compared around, but not far from it.
    """
    other = jnp.asarray(rivals([*free_parameters(larger)]))[chosen.taken]
    return other, *to_fit(larger, every, other)


def to_fit(larger, every: Fit, index: Int[Array, ""]) -> tuple[Float[Array, " p"], Bool[Array, "2 p"]]:
    """Return by how much to move the parameters before a candidate is fitted, and which are free: none, and its own."""
    start, free = ravel_parameters(larger)[0], jnp.stack([*free_parameters(larger).values()])[index]
    return without_others(every, free, start).astype(start.dtype), jnp.stack([jnp.zeros_like(free), free])


@jit_by_size(UNOPTIMISED)
def better(
    larger, every: Fit, fits: tuple, chosen: Posterior, other: Int[Array, ""], nothing: Unchanged, sizes
) -> tuple[Any, Posterior]:
    """Return the more probable of the chosen change and another, with the errors around the fit of each.

    The other must be plausible (`FAR`): with updrafts, a storm can imitate a force.
    """
    start, free = ravel_parameters(larger)[0], jnp.stack([*free_parameters(larger).values()])
    pair, variance = jnp.stack([chosen.taken, other]), dispersion(every, sizes)

    def log_evidence(fit: Fit, free: Bool[Array, " p"]) -> Float[Array, ""]:
        explained = _explained(fit, start, sizes, variance, free & fit.seen, nothing.apparent)[1]
        total = explained - jnp.sum(fit.at(start).square) / (2 * variance)
        return jnp.where(jnp.isfinite(total), total, -1e30)

    odds = jax.nn.softmax(jnp.stack([log_evidence(fit[0], free[i]) for fit, i in zip(fits, pair, strict=True)]))
    plausible = jnp.all(jnp.abs(fits[1][0].theta - start) <= FAR * sizes)
    odds = jnp.where(plausible, odds, jnp.array([1.0, 0.0]))

    def divided(both: Float[Array, " c"]) -> Float[Array, " c"]:
        return jnp.where(other == chosen.taken, both, both.at[pair].set(jnp.sum(both[pair]) * odds))

    wins = (odds[1] > odds[0]) & (other != chosen.taken)
    probability, naive = divided(chosen.probability), divided(chosen.naive)
    found = jax.tree.map(partial(jnp.where, wins), *reversed(fits))
    return found, chosen._replace(probability=probability, naive=naive, taken=jnp.where(wins, other, chosen.taken))


def _explained(
    around: Fit, start, sizes, variance: Float[Array, ""], free: Bool[Array, " p"], apparent: Float[Array, " p"]
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Return the change of a candidate's parameters, and its evidence beyond that of the errors at the start.

    A parameter with an infinite size gets the variance that one window determines as its prior.
    """
    information = jnp.sum(around.equations.gram, axis=0) / variance
    pull = -jnp.sum(around.at(start).score, axis=0) / variance
    one_window = len(around.equations.score) / jnp.maximum(jnp.diagonal(information), TINY)
    change = jnp.where(free, jnp.where(jnp.isfinite(sizes), jnp.square(sizes), one_window), 0.0)
    wide, free = jnp.maximum(change + apparent, TINY), change + apparent > 0
    held = jnp.where(free & free[:, None], information, 0.0) + jnp.diag(jnp.where(free, 1 / wide, 1.0))
    # All eigenvalues are only as exact as the largest, so the matrix is scaled to a unit diagonal.
    unit = 1 / jnp.sqrt(jnp.diagonal(held))
    values, vectors = jnp.linalg.eigh(unit[:, None] * held * unit)
    values = jnp.maximum(values, len(values) * jnp.finfo(values.dtype).eps)
    along = vectors.T @ jnp.where(free, unit * pull, 0.0)
    volume = 2 * jnp.log(unit) - jnp.where(free, jnp.log(wide), 0.0) - jnp.log(values)
    mean = change / wide * unit * (vectors @ (along / values))
    return mean, 0.5 * jnp.sum(jnp.square(along) / values + volume)


def dispersion(found: Fit, sizes) -> Float[Array, ""]:
    """Estimate the variance of an error from the variation between blocks (Wedderburn 1974), at least the noise's."""
    places, counted = blocks_of(len(found.equations.score), BLOCKS)
    score = jnp.sum(found.equations.score[places] * counted[..., None], axis=1)
    total = jnp.sum(found.equations.gram, axis=0)
    # Scaled to unit effect; parameters that are not identifiable stay at the source.
    prior = found.noise / jnp.square(sizes)
    unit = 1 / jnp.sqrt(jnp.diagonal(total) + prior)
    held = unit[:, None] * (total + jnp.diag(prior)) * unit
    matrix = inverse(held).matrix
    spread = jnp.einsum("bp,pq,bq->", score * unit, matrix, score * unit) * len(places) / max(len(places) - 1, 1)
    return jnp.maximum(spread / jnp.maximum(jnp.sum(matrix * unit[:, None] * total * unit), TINY), found.noise)
