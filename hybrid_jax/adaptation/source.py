"""Whether physics replaces the source, and how exactly its own motion determines the parameters that are inherited."""

from collections.abc import Callable
from operator import itemgetter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax import checks
from hybrid_jax.adaptation import anchored, selection
from hybrid_jax.adaptation.selection import Fit
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import sandwich_with_prior
from hybrid_jax.runtime import FASTEST_COMPILE, UNOPTIMISED, jit_by_size
from hybrid_jax.trajectories import Trajectories

MANY = 10  # times as many windows as the new ones: then the source's errors are small beside the new ones'


class OfSource(NamedTuple):
    """What the source's own motion tells about it."""

    own: Fit  # to as many windows of that motion as the new ones
    alone: Bool[Array, ""]  # whether physics without the network replaced the source
    covariance: Float[Array, "p p"]  # of the errors of its parameters if it did, else 0
    degrees: Float[Array, ""]  # degrees of freedom of the errors of its parameters


@jit_by_size(FASTEST_COMPILE)
def fit_pair(field, move, windows: Trajectories, free, *options) -> tuple[Fit, Fit, Any]:
    """Fit no parameters and the free ones, from parameters moved by `move`, at which the starts are smoothed too."""
    start, unravel = ravel_parameters(field)
    found, starts = selection.fit_each(unravel((start + move).astype(start.dtype)), windows, free, *options, moved=move)
    return (*(jax.tree.map(itemgetter(row), found) for row in (0, 1)), starts)


def judge_source(
    larger, physics, known: Trajectories, windows: Trajectories, options: tuple, blocks: int, networks: bool
) -> tuple[Any, OfSource]:
    """Return the source, or physics if that predicts the `known` windows better, and what these tell about it.

    Args:
        options: of `fit_pair`, first the prior standard deviations.
        networks: whether the source's network may go.
    """
    part, (sizes, *_), n = selection.alike(known, windows), options, len(windows)
    nothing, distinct = np.zeros(sizes.shape, sizes.dtype), jnp.array(min(len(known), n))
    both = np.outer([0, 1], np.ones(sizes.shape)) > 0  # fit nothing, and everything
    own = fit_pair(larger, nothing, part, both, *options, distinct)[0]
    if physics is None:
        zero = jnp.zeros((len(sizes), len(sizes)), sizes.dtype)
        return larger, OfSource(own, jnp.array(False), zero, jnp.maximum(distinct - 1.0, 1.0))
    rival = fit_pair(physics, nothing, part, both, *options, distinct)[:2]
    larger, source, again = _replace(larger, own, rival, distinct, sizes, blocks, networks)
    traced = any(map(checks.is_traced, jax.tree.leaves((physics, known, windows))))
    if not traced and (again or not source.alone):
        return larger, source
    many = selection.alike(known, windows, n * min(-(-len(known) // n), MANY))
    found = _linearised(physics, many, n, options, distinct, jax.lax.map if traced else _one_by_one)
    return larger, _inherited(source, again, found, jnp.array(min(len(known), len(many))), sizes)


def _linearised(physics, many: Trajectories, n: int, options: tuple, distinct: Int[Array, ""], over: Callable) -> Fit:
    """Return the errors of `many` windows and their Jacobians, n at a time, for which the program exists already."""
    nothing = np.zeros(options[0].shape, options[0].dtype)
    neither = np.zeros((2, *nothing.shape), bool)
    parts = jax.tree.map(lambda leaf: leaf.reshape(-1, n, *leaf.shape[1:]), many)
    return over(lambda some: fit_pair(physics, nothing, some, neither, *options, distinct)[0], parts)


def _one_by_one(function: Callable, parts: Any) -> Any:
    each = [function(jax.tree.map(itemgetter(i), parts)) for i in range(len(jax.tree.leaves(parts)[0]))]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


@jit_by_size(UNOPTIMISED)
def _replace(
    larger, own: Fit, rival: tuple[Fit, Fit], distinct: Int[Array, ""], sizes, blocks: int, networks: bool
) -> tuple[Any, OfSource, Bool[Array, ""]]:
    """Replace the source by its physics if that is surely better; also return whether refitted physics is better."""
    start, unravel = ravel_parameters(anchored.without_network(larger))
    places = selection.blocks_of(len(own.equations.score), blocks)
    left_out = selection.left_out_thetas(rival[1], jnp.ones(len(start), bool), sizes, start, places)
    again = selection.surely_lower(rival[1], rival[0], left_out, places)
    physics, left_out = _where(again, rival[1], rival[0]), jnp.where(again, left_out, start)
    alone = selection.surely_lower(physics, own, left_out, places) & networks
    larger, own = (_where(alone, *pair) for pair in ((unravel(physics.theta), larger), (physics, own)))
    refitted, _ = sandwich_with_prior(own.equations, len(start), distinct, own.noise / jnp.square(sizes))
    degrees = jnp.maximum(distinct - jnp.where(alone, len(start), 1), 1.0)
    return larger, OfSource(own, alone, jnp.where(alone, refitted, 0.0), degrees), again


@jit_by_size(UNOPTIMISED)
def _inherited(source: OfSource, again: Bool[Array, ""], found: Fit, distinct: Int[Array, ""], sizes) -> OfSource:
    """Take the covariance from many windows if the source's parameters were kept.

    These are not the minimum, as they were not fitted in this way: the step to it counts as an error.
    """
    equations = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found.equations)
    precision = jnp.mean(found.noise) / jnp.square(sizes)
    covariance, step = sandwich_with_prior(equations, len(sizes), distinct, precision)
    kept, degrees = source.alone & ~again, jnp.maximum(distinct - len(sizes), 1.0)
    return source._replace(
        covariance=jnp.where(kept, covariance + jnp.outer(step, step), source.covariance),
        degrees=jnp.where(kept, degrees, source.degrees),
    )


def _where(which: Bool[Array, ""], one: Any, other: Any) -> Any:
    arrays, rest = eqx.partition(other, eqx.is_array)
    return eqx.combine(jax.tree.map(lambda a, b: jnp.where(which, a, b), eqx.filter(one, eqx.is_array), arrays), rest)
