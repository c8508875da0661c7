"""Fits of changes, the source's own errors, and left-out blocks of windows."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.estimation import normal_equations
from hybrid_jax.estimation.least_squares import Scale, Solver, fit_and_linearise, ravel_parameters, rounding
from hybrid_jax.estimation.normal_equations import NormalEquations, inverse, masked
from hybrid_jax.estimation.starts import Starts, from_starts, smoothed
from hybrid_jax.estimation.uncertainty import sandwich
from hybrid_jax.trajectories import RANGE, Trajectories

BLOCKS = 10
CLUSTERS = 5  # of a flight's windows, for intervals: in gusts, errors a second apart are still correlated
FEW = 10  # with fewer windows, their order cannot be recognised
SHIFTS = 20  # number of other windows with which each is compared
SURELY = 2.0  # standard errors by which one model must predict better to replace another
ENOUGH = 5  # blocks that give a standard error
MOST = 1.0  # largest log-gain of a block that counts: more would only add to the standard error
ALIKE = 2  # so many blocks of a flight count as one: neighbouring blocks are alike, and another flight differs more
ERRING = 0.2  # error of a network over its effect, if its training windows are unknown
TINY = float(np.finfo(np.float32).tiny)


class Fit(NamedTuple):
    """A fit to n windows, and the quadratic form of the squared errors around it."""

    theta: Float[Array, " p"]  # the p parameters, in the order of `ravel_parameters`
    equations: NormalEquations  # of each window, at theta
    noise: Float[Array, ""]  # variance of one error over scale, from differences of successive errors
    seen: Bool[Array, " p"]  # which parameters the windows determine beyond rounding and better than the prior
    steps: Int[Array, ""]  # evaluations of the Jacobian
    status: Int[Array, ""]  # how it ended, a `Status`

    def at(self, theta: Float[Array, " p"]) -> NormalEquations:
        (gram, score, square), move = self.equations, theta - self.theta
        return NormalEquations(gram, score + gram @ move, square + (2 * score + gram @ move) @ move)


def fit_each(
    field: AbstractVectorField,
    windows: Trajectories,
    free,
    sizes,
    solver: Solver,
    scale: Scale,
    max_steps: int,
    distinct: Int[Array, ""] | None = None,
    moved: Float[Array, " p"] | float = 0.0,
) -> tuple[Fit, Starts | None]:
    """Fit the free parameters of each candidate, with the prior `sizes`; also return the `smoothed` starts.

    The field's parameters are `moved` from the centre of the prior; for `distinct` see `fit_and_linearise`.
    """
    starts, noise = smoothed(field, windows, solver, scale)
    smooth, weigh = from_starts(windows, starts)
    noise = jnp.maximum(noise, jnp.square(rounding(windows, scale)) / windows.x.size)

    def one(known, free: Bool[Array, " p"]):
        held, given = jnp.sqrt(noise) / sizes, (field, smooth, solver, max_steps, scale)
        found, jacobian, r = fit_and_linearise(*given, free, weigh, held, distinct, known, moved)
        equations = jax.vmap(normal_equations.equations_of)(jacobian, r)
        # A parameter that windows determine less than the prior could have any value at nearly the same error.
        more = jnp.diagonal(jnp.sum(equations.gram, axis=0)) > noise / jnp.square(sizes)
        seen = more & normal_equations.has_effect(equations, windows, scale)
        theta = ravel_parameters(found.field)[0]
        fit = Fit(theta, masked(equations, seen), noise, seen, found.steps, found.status)
        return (jacobian, r, ~jnp.any(free)), fit  # if nothing was fitted, these are at the start

    shape = jax.eval_shape(weigh, smooth.x)
    nothing = (*(jnp.zeros((*shape.shape, *more), shape.dtype) for more in (free.shape[1:], ())), jnp.array(False))
    return jax.lax.scan(one, nothing, jnp.asarray(free))[1], starts


class Unchanged(NamedTuple):
    """The source's own errors: the `apparent` variance of each parameter, and the summed squared `error` over scale."""

    apparent: Float[Array, " p"]
    error: Float[Array, ""]


def unchanged(
    own: Fit | None, found: Fit, added: Float[Array, ""] | float, quantities: int, learned_from, shares
) -> Unchanged:
    """Estimate apparent changes beyond noise from the source's own motion (DerSimonian and Laird 1986).

    Where windows are unlike that motion (`shares_outside`), the network's error is taken to be as large as its effect,
    and a fifth of it if that motion is unknown. Each parameter could explain a share of that error, see
    `anchored.quantities_of`.
    """
    outside, missed = (ERRING, 1.0) if own is None else shares
    unknown = jnp.square(outside * missed) * jnp.asarray(added)
    information = jnp.sum(jnp.diagonal(found.equations.gram, axis1=1, axis2=2), axis=0)
    of_network = Unchanged(unknown / quantities / jnp.maximum(information, TINY), unknown)
    if own is None:
        return of_network
    places = jnp.maximum(1.0, (1 - missed) * len(found.equations.score))
    known = jnp.diagonal(own.equations.gram, axis1=1, axis2=2)
    beyond = jnp.sum(jnp.square(own.equations.score) - own.noise * known, axis=0)
    apparent = jnp.maximum(beyond, 0.0) / jnp.maximum(jnp.sum(jnp.square(known), axis=0), TINY)
    total = jnp.maximum(jnp.sum(own.equations.square) - own.noise * jnp.sum(~jnp.isnan(learned_from.x)), 0.0)
    return Unchanged(apparent / places + of_network.apparent, total / places + of_network.error)


def alike(learned_from: Trajectories, windows: Trajectories, n: int | None = None) -> Trajectories:
    """Repeat, select and shorten the source's windows: n of the others' length, by default as many as these."""
    n, m, t = len(windows) if n is None else n, len(learned_from), windows.horizon
    places = np.arange(n) * m // n if m < n else np.linspace(0, m - 1, n).astype(int)  # copies are in one block
    own = Trajectories(learned_from.x0, learned_from.u[:, :t], learned_from.x[:, :t], learned_from.dt)
    return jax.tree.map(lambda leaf, other: jnp.asarray(leaf[places], jnp.result_type(other)), own, windows)


def spread(equations: NormalEquations, free: Bool[Array, " p"], of_source: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """Propagate the covariance of the parameters that are not free to the fitted ones."""
    gram = jnp.sum(equations.gram, axis=0)
    fitted = inverse(jnp.sum(masked(equations, free).gram, axis=0)).matrix * free * free[:, None]
    known = jnp.isfinite(jnp.diagonal(of_source))
    effect = jnp.where(free | ~known, 0.0, fitted @ gram)
    found = effect @ jnp.where(known & known[:, None], of_source, 0.0) @ effect.T
    return found + jnp.diag(jnp.maximum(-jnp.diagonal(found), 0.0))  # rounding


def variance_if_free(equations: NormalEquations, free: Bool[np.ndarray, " p"], cluster: int) -> Float[np.ndarray, " p"]:
    """Return each parameter's variance if these were fitted as well, and the square of the step that it would take.

    It is how far the windows let a parameter be from where it was kept: infinite if they do not determine it.
    """
    seen = (np.asarray(equations.score) != 0).any(axis=0)
    equations = masked(equations, free)
    gram, score = (np.asarray(part, float).sum(axis=0) for part in equations[:2])
    unit = 1 / np.sqrt(np.maximum(np.diagonal(gram), TINY))
    least = normal_equations.RANK * len(gram) * np.finfo(equations.gram.dtype).eps
    step = unit * (np.linalg.pinv(unit[:, None] * gram * unit, least, hermitian=True) @ (unit * score))
    variance = np.diagonal(sandwich(equations, int(free.sum()), cluster))
    return np.where(free & ~seen, np.inf, variance + step**2)


def shares_outside(field: AbstractVectorField, known: Trajectories, asked: Trajectories) -> Float[Array, "2"]:
    """Return the largest share of samples outside the other windows' 1 to 99 % range, over quantities of the state.

    The first is of `asked` outside `known`: pass all known windows, since a few have a narrower range. Inputs do not
    count: a changed vehicle, for example with a load, needs different inputs for the same motion.
    """
    space, t = state_space(field, known.x0.shape[-1]), min(known.horizon, asked.horizon)

    def features(windows: Trajectories) -> list[Array]:
        x: Any = jnp.asarray(windows.x)[:, :t].reshape(-1, windows.x.shape[-1])
        found = [*space.features(x, 0 * x[:, :1]).values()]
        return [jnp.stack([each for each in found if len(each) == size]) for size in sorted({*map(len, found)})]

    def share(inside: Array, other: Array) -> Float[Array, ""]:
        low, high = jnp.nanquantile(inside, jnp.asarray(RANGE), axis=1, keepdims=True)
        return jnp.max(jnp.mean((other < low) | (other > high), axis=1))

    pair = features(known), features(asked)
    shares = [[share(*each) for each in zip(*both, strict=True)] for both in (pair, pair[::-1])]
    return jnp.max(jnp.asarray(shares), axis=1)


def blocks_of(
    windows: int, blocks: int, flights: Int[np.ndarray, " n"] | None = None
) -> tuple[Int[np.ndarray, "b m"], Bool[np.ndarray, "b m"]]:
    """Return the window indices of each block, or flight, and which count: a short block repeats its last window."""
    if flights is not None:
        first, sizes = np.unique(flights, return_index=True, return_counts=True)[1:]
        own = np.arange(sizes.max())
        return first[:, None] + np.minimum(own, sizes[:, None] - 1), own < sizes[:, None]
    each = -(-windows // min(blocks, windows))
    index = np.arange(-(-windows // each) * each).reshape(-1, each)
    return np.minimum(index, windows - 1), index < windows


def left_out_steps(
    equations: NormalEquations, held: Float[Array, "p p"], pull: Float[Array, " p"], blocks
) -> Float[Array, "b p"]:
    """Compute the Gauss–Newton step without each block, with a penalty's matrix and half slope."""
    places, counted = blocks
    gram = jnp.sum(equations.gram[places] * counted[..., None, None], axis=1)
    score = jnp.sum(equations.score[places] * counted[..., None], axis=1)
    return normal_equations.steps_without(jnp.sum(gram, axis=0) + held, jnp.sum(score, axis=0) + pull, gram, score)


def left_out_thetas(found: Fit, free: Bool[Array, " p"], sizes, start, blocks) -> Float[Array, "b p"]:
    """Compute the parameters fitted without each block, with the prior `sizes` around `start`."""
    free = free & found.seen
    held = jnp.diag(jnp.where(free, found.noise / jnp.square(sizes), 0.0))
    return found.theta + left_out_steps(masked(found.equations, free), held, held @ (found.theta - start), blocks)


def without_others(every: Fit, free: Bool[Array, " p"], start) -> Float[Array, " p"]:
    """Return the change of the free parameters if the others stay, to first order around a fit of all.

    Parameters are correlated: if the others were simply set back, predictions could be far worse than at the start.
    """
    gram, change = jnp.sum(every.equations.gram, axis=0), every.theta - start
    others = jnp.where(free, 0.0, change)
    taken = inverse(jnp.sum(masked(every.equations, free).gram, axis=0)).matrix @ jnp.where(free, gram @ others, 0.0)
    return jnp.where(free, change + taken, 0.0)


def surely_lower(found: Fit, still: Fit, thetas: Float[Array, "b p"], blocks) -> Bool[Array, ""]:
    """Return whether a change is `surely` better in left-out blocks; see `left_out_thetas`."""
    after = jax.vmap(lambda theta, place: found.at(theta).square[place])(thetas, blocks[0])
    before, after = (jnp.sum(square * blocks[1], axis=1) for square in (still.equations.square[blocks[0]], after))
    enough = surely(before, after)
    return enough if len(before) >= ENOUGH else jnp.array(True)


def surely(before: Float[Array | np.ndarray, " b"], after: Float[Array | np.ndarray, " b"]) -> Bool[Array, ""]:
    """Return whether the log-error of left-out blocks falls by more than `SURELY` standard errors.

    Evidence assumes independent errors, but errors are correlated where physics lacks something. `ALIKE` neighbouring
    blocks count as one. The logarithm is the likelihood of a block of unknown variance, so that no block outweighs the
    others. Gains count up to `MOST`: a change that a few blocks show clearly, and the others a little, is as certain.
    """
    least = jnp.maximum(jnp.finfo(before.dtype).eps * before, TINY)
    gain = jnp.minimum(jnp.log(jnp.maximum(before, least) / jnp.maximum(after, least)), MOST)
    return jnp.mean(gain) > SURELY * jnp.std(gain, ddof=1) * (ALIKE / len(gain)) ** 0.5


def correlated(windows: Trajectories) -> int:
    """Return how many consecutive windows form a cluster: a fifth if they are from one or a few flights, else 1."""
    starts, ends = np.asarray(windows.x0), np.asarray(windows.x)[:, -1]
    touch = bool((starts[1:] == ends[:-1]).all(axis=1).any())
    of_flights = touch or overlap(windows) or _follow(starts, ends)
    return blocks_of(len(windows), CLUSTERS)[0].shape[1] if of_flights else 1


def _follow(starts: Float[np.ndarray, "n d"], ends: Float[np.ndarray, "n d"]) -> bool:
    """Return whether windows begin much nearer to the end of the previous one than to other ends, after a gap."""
    n, spread = len(starts), np.std(starts, axis=0)
    if n < FEW or not spread.any():
        return False
    starts, ends = (part[:, spread > 0] / spread[spread > 0] for part in (starts, ends))
    shifts = np.linspace(1, n - 1, SHIFTS + 1, dtype=int)
    near, *others = (np.linalg.norm(np.nan_to_num(np.roll(starts, -k, axis=0) - ends), axis=1) for k in shifts)
    return bool(np.median(near) < np.median(others) / 2)


def overlap(windows: Trajectories) -> bool:
    return bool((np.asarray(windows.x0)[1:, None] == np.asarray(windows.x)[:-1, :-1]).all(axis=-1).any())
