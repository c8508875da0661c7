"""Choose what to adapt by the prediction of windows that were left out.

More parameters always fit the same windows better. So the windows are cut into blocks, each block is predicted by a fit
to all others, and the simplest candidate is taken whose error is within one standard error, or a tenth, of the smallest
(Breiman, Friedman, Olshen and Stone, Classification and Regression Trees, 1984, Sec. 3.4.3). Errors are compared as
ratios: a block with large errors must not decide alone. Windows that touch are predicted as one, since a model that is
good for 0.1 s can be bad after 1 s.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.estimation.least_squares import Scale, Solver, fit_and_linearise, ravel_parameters
from hybrid_jax.estimation.normal_equations import equations_of, has_effect, masked, steps_without
from hybrid_jax.estimation.starts import Starts, Sums, from_starts, unknown_starts
from hybrid_jax.integrate import compact, rollout
from hybrid_jax.trajectories import Trajectories

BLOCKS = 10
CLUSTERS = 5  # of windows of one flight, for intervals: in gusts, errors a second apart are still correlated
TOLERANCE = 0.1  # relative difference of errors that does not count
FEW = 10  # windows, of which no order is seen
SHIFTS = 20  # other windows that each is compared with
JOINED = 10  # windows that touch, at most so many, are predicted as one


class BlockErrors(NamedTuple):
    """Of one block, or of several, with windows that touch predicted as one.

    Attributes:
        mse: mean over the windows of the squared error at each step.
        ends: mean squared error of each state at the end of a window, and of those that touch (2, d).
    """

    mse: Float[Array, "*b"]
    ends: Float[Array, "*b 2 d"]


class Fits(NamedTuple):
    """Least squares for each of c candidates, and how well it predicts each of b blocks that were left out.

    Attributes:
        theta: the parameters of each candidate, in the order of `ravel_parameters` (c, p).
        errors: of each candidate on each block (c, b).
        mse: of each candidate on all windows, over scale.
        steps: evaluations of the Jacobian of each fit.
        converged: whether each fit stopped before the most steps, at a finite error.
    """

    theta: Float[Array, "c p"]
    errors: BlockErrors
    mse: Float[Array, " c"]
    steps: Int[Array, " c"]
    converged: Bool[Array, " c"]


@eqx.filter_jit
def fit_candidates(
    field: AbstractVectorField,
    windows: Trajectories,
    free: Bool[np.ndarray, "c p"],
    solver: Solver = None,
    max_steps: int = 100,
    scale: Scale = None,
    blocks: int = BLOCKS,
    starts: Starts | None = None,
    held: Float[Array, " p"] | float = 0.0,
) -> Fits:
    """Fit the parameters that each candidate leaves free; the others stay as they are.

    A block is predicted with the parameters of one Gauss-Newton step, from the fit to all windows, on the other blocks.

    Args:
        free: for each candidate which of the parameters, in the order of `ravel_parameters`, are fitted.
        windows: in the order of time.
        starts: of the windows, see `smoothed`; by default as they were measured.
        held: what a parameter's distance from the field's counts as, see `fit_and_linearise`.
    """
    start, at = ravel_parameters(field)
    smooth, weigh = from_starts(windows, starts)
    held = jnp.broadcast_to(jnp.asarray(held, start.dtype), start.shape)
    places, counted = blocks_of(len(windows), blocks)
    own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[places], (windows, starts))

    def one(free: Bool[Array, " p"]):
        found, jacobian, r = fit_and_linearise(field, smooth, solver, max_steps, scale, free, weigh, held)
        theta = ravel_parameters(found.field)[0]
        equations = jax.vmap(equations_of)(jacobian, r)
        equations = masked(equations, free & has_effect(equations, windows, scale))
        prior = jnp.diag(jnp.square(held)) * (free & free[:, None])
        pull = prior @ (theta - start)
        without = theta + left_out_steps(equations.gram, equations.score, places, counted, prior, pull)

        def error(left_out):
            theta, windows, starts, counted = left_out
            return predict_block(at(theta), windows, starts, counted, solver, scale)

        errors = jax.lax.map(error, (without, *own, counted))
        return theta, errors, found.mse, found.steps, found.converged

    return Fits(*jax.lax.map(one, jnp.asarray(free)))


def blocks_of(windows: int, blocks: int) -> tuple[Int[np.ndarray, "b m"], Bool[np.ndarray, "b m"]]:
    """The indices of the windows of each block, consecutive ones, and which count: a short block repeats its last."""
    each = -(-windows // min(blocks, windows))
    index = np.arange(-(-windows // each) * each).reshape(-1, each)
    return np.minimum(index, windows - 1), index < windows


def left_out_steps(
    gram: Float[Array, "n p p"],
    score: Float[Array, "n p"],
    places: Int[np.ndarray, "b m"],
    counted: Bool[np.ndarray, "b m"],
    held: Float[Array, "p p"] | float = 0.0,
    pull: Float[Array, " p"] | float = 0.0,
) -> Float[Array, "b p"]:
    """The Gauss-Newton step on all blocks but one, for each block; `held` is the matrix of a penalty, `pull` its half
    slope."""
    weight = counted[..., None]
    gram = jnp.sum(gram[places] * weight[..., None], axis=1)
    score = jnp.sum(score[places] * weight, axis=1)
    return steps_without(jnp.sum(gram, axis=0) + held, jnp.sum(score, axis=0) + pull, gram, score)


def predict_block(
    field: AbstractVectorField,
    block: Trajectories,
    starts: Starts | None,
    counted: Bool[Array, " m"],
    solver: Solver = None,
    scale: Scale = None,
) -> BlockErrors:
    """The errors of a field on the windows of a block that count, without what other starts would change."""
    free = starts is not None
    starts = unknown_starts(block) if starts is None else starts

    def one(carry, item):
        (end, smooth_end), recorded, sums = carry
        window, start, counted, i = item
        touches = counted & jnp.all(window.x0 == recorded) & (i % JOINED > 0)
        begin = jnp.stack([window.x0, jnp.where(touches, end, window.x0), jnp.where(touches, smooth_end, start.x0)])
        alone, predicted, smooth = jax.vmap(lambda x0: rollout(field, x0, window.u, block.dt, compact(solver)))(begin)
        difference = window.x - smooth if scale is None else (window.x - smooth) / scale
        sums = jax.tree.map(lambda one, new: jnp.where(touches, one, new), sums, Sums.of(start.jump, start.trust))
        sums = sums.and_those(difference, start.effect)
        error = sums.unexplained() if free else sums.square
        ends = jnp.square(jnp.stack([alone[-1], predicted[-1]]) - window.x[-1])
        return ((predicted[-1], smooth[-1]), window.x[-1], sums), (jnp.where(counted, error, 0.0), ends, touches)

    nowhere = jnp.full_like(block.x0[0], jnp.nan)  # touches nothing
    begin = (nowhere, nowhere), nowhere, Sums.of(starts.jump[0], starts.trust[0])
    _, (errors, ends, touches) = jax.lax.scan(one, begin, (block, starts, counted, jnp.arange(len(counted))))
    last = counted & ~jnp.roll(touches, -1).at[-1].set(False)  # windows after which no other goes on
    weights = jnp.stack([counted / jnp.sum(counted), last / jnp.sum(last)], axis=1)
    mse = jnp.sum(jnp.where(last, errors, 0.0)) / (jnp.sum(counted) * block.x.shape[1])
    return BlockErrors(mse, jnp.einsum("mh,mhd->hd", weights, ends))


def correlated(windows: Trajectories) -> int:
    """How many consecutive windows to take as one cluster: a fifth where they are of one flight, or of a few."""
    starts, ends = np.asarray(windows.x0), np.asarray(windows.x)[:, -1]
    touch = bool((starts[1:] == ends[:-1]).all(axis=1).any())
    of_flights = touch or overlap(windows) or _follow(starts, ends)
    return blocks_of(len(windows), CLUSTERS)[0].shape[1] if of_flights else 1


def _follow(starts: Float[np.ndarray, "n d"], ends: Float[np.ndarray, "n d"]) -> bool:
    """Whether windows begin much nearer to the end of the one before than to those of others, after a gap."""
    n, spread = len(starts), np.std(starts, axis=0)
    if n < FEW or not spread.any():
        return False
    starts, ends = (part[:, spread > 0] / spread[spread > 0] for part in (starts, ends))
    shifts = np.linspace(1, n - 1, SHIFTS + 1, dtype=int)
    near, *others = (np.linalg.norm(np.roll(starts, -k, axis=0) - ends, axis=1) for k in shifts)
    return bool(np.median(near) < np.median(others) / 2)


def overlap(windows: Trajectories) -> bool:
    """Whether a window begins inside of the one before."""
    return bool((np.asarray(windows.x0)[1:, None] == np.asarray(windows.x)[:-1, :-1]).all(axis=-1).any())


def longest_chain(windows: Trajectories, blocks: int) -> int:
    """How many windows that touch are predicted as one, at most."""
    x0, x, longest = np.asarray(windows.x0), np.asarray(windows.x), 1
    for places, counted in zip(*blocks_of(len(windows), blocks), strict=True):
        own = places[counted]
        touches = (x0[own[1:]] == x[own[:-1], -1]).all(axis=1)
        length = 1
        for i, touch in enumerate(touches, 1):
            length = length + 1 if touch and i % JOINED else 1
            longest = max(longest, length)
    return longest


def simplest(errors: Float[Array, "c b"], sizes: Int[np.ndarray, " c"]) -> Int[Array, ""]:
    """The candidate of the smallest size whose log error is within one standard error, or a tenth, of the best.

    Of several of this size, the best. A candidate with an error that is not finite is not taken; 0 if all are.
    """
    logs = _logarithm(errors)
    mean = jnp.where(jnp.isfinite(logs).all(axis=1), jnp.mean(logs, axis=1), jnp.inf)
    worse = logs - logs[jnp.argmin(mean)]
    margin = jnp.std(worse, axis=1, ddof=1) / jnp.sqrt(errors.shape[1])
    near = jnp.isfinite(mean) & (jnp.mean(worse, axis=1) <= jnp.maximum(margin, TOLERANCE))
    order = np.asarray(sizes) * len(sizes) + jnp.argsort(jnp.argsort(mean))
    return jnp.argmin(jnp.where(near, order, np.iinfo(np.int32).max))


@jax.jit  # as one small program, not four
def geometric_mean(errors: Float[Array, "c b"]) -> Float[Array, " c"]:
    """Over the blocks."""
    return jnp.exp(jnp.mean(_logarithm(errors), axis=1))


def _logarithm(errors: Float[Array, "c b"]) -> Float[Array, "c b"]:
    return jnp.log(jnp.maximum(errors, jnp.finfo(errors.dtype).tiny))  # an exact prediction has none
