"""The error on an unseen flight, from flights or blocks of windows that were left out of the fit."""

import warnings
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # not scipy.stats, which takes half a second to import
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax.adaptation import anchored
from hybrid_jax.adaptation.selection import ALIKE, ENOUGH, MOST
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.estimation.least_squares import Scale, Solver, ravel_parameters
from hybrid_jax.integrate import compact, rollout
from hybrid_jax.runtime import UNOPTIMISED, jit_by_size
from hybrid_jax.state_space import StateSpace
from hybrid_jax.trajectories import Trajectories, errors_of

LEVEL = 0.8
USUAL = 0.95  # level of the interval in which the error of a flight like the source's is
JOINED = 10  # adjacent windows, at most so many, are joined and predicted as one
PARTS = 30  # of the source's flights, at most so many
FAR = 30  # times the error: wider intervals say nothing and are not printed
NO_INTERVAL = "no interval: the parts left out are too few or differ too much"
Expected = Mapping[str, Mapping[str, tuple[float, float, float]]]  # horizon → quantity → value, low, high


def expected(logs: Float[np.ndarray, "n ..."], flights: int | None = None) -> Float[np.ndarray, "3 ..."]:
    """Return the expected error on another flight and its 80 % interval, by Student's t for the flights' log-errors.

    For log-errors of parts of flights, pass the number of `flights`: their means are assumed to vary like the parts.
    """
    n, middle = len(logs), np.mean(logs, axis=0)
    if n < 2:
        return np.stack([np.exp(middle), np.zeros_like(middle), np.full_like(middle, np.inf)])
    error = np.std(logs, axis=0, ddof=1) * (1 + 1 / (flights or n)) ** 0.5
    half = scipy.special.stdtrit(n - 1, (1 + LEVEL) / 2) * error
    return np.exp([middle, middle - half, middle + half])


def parts_of_flights(learned_from: Trajectories | None, windows: Trajectories) -> list[slice]:
    """Return where the source's training windows follow each other for as long as `windows`, for at most `PARTS` parts.

    There are none if the training windows are unknown or of another length, or give fewer parts than `ENOUGH`.
    """
    n, first, parts = len(windows), 0, list[slice]()
    if learned_from is None or learned_from.horizon != windows.horizon or not np.isclose(learned_from.dt, windows.dt):
        return parts
    breaks = (np.asarray(learned_from.x0)[1:] != np.asarray(learned_from.x)[:-1, -1]).any(axis=1)
    for end in [*np.flatnonzero(breaks) + 1, len(learned_from)]:
        parts += [slice(at, at + n) for at in range(first, end - n + 1, n)]
        first = end
    kept = np.linspace(0, len(parts) - 1, min(len(parts), PARTS)).astype(int)
    return [parts[i] for i in kept] if len(parts) >= ENOUGH else []


def expected_errors(
    squares: Float[np.ndarray, "b 2 d"],
    seconds: tuple[float, float],
    space: StateSpace,
    flights: bool = False,
    of_source: Float[np.ndarray, "r 2 d"] | None = None,
) -> Expected:
    """Return the RMSE at the end of single and of joined windows, with an 80 % prediction interval for another flight.

    `squares` are mean squared errors, NaN where a state was not measured, of whole flights if `flights` (see
    `expected`), else of blocks of one flight; `seconds` are the durations of the windows. Intervals (Hahn and Meeker,
    Statistical Intervals, 1991, Sec. 4.7) use Student's t for the logarithm of the mean square of a flight.

    Its variance is that of the source's errors on parts of its own flights, each as long as this flight (`of_source`),
    if this flight's error is in their 95 % prediction interval. Otherwise it comes from the blocks. Squares are skewed,
    and a few blocks seldom contain the largest, so their sample standard deviation is too small. They are taken as
    lognormal: the logarithm of the mean then has the variance s²/b + s⁴ / (2 (b − 1)), with s² the variance of the
    logarithms (Cox's method; Zhou and Gao, Statistics in Medicine 1997), and `ALIKE` blocks count as one.
    """
    blocks = len(squares)
    with warnings.catch_warnings(action="ignore"):  # a state that no end measures
        squares = np.where(np.isnan(squares), np.nanmean(squares, axis=0), squares)
    squares = np.where(np.isfinite(squares), squares, np.nan)  # a diverged one has no RMSE

    def power_of(squares: Float[np.ndarray, "n 2 d"], group: slice, factor: float, horizon: int) -> Array:
        return np.maximum(factor**2 * squares[:, horizon, group].sum(axis=-1), np.finfo(np.float32).tiny)

    def around(*which) -> tuple[float, float, float]:
        power, variance, degrees = power_of(squares, *which), np.inf, 1
        if flights:
            value, low, high = expected(np.log(power) / 2)
            return float(value), float(low), float(high)
        if blocks > 1:
            variance, degrees = np.log(power).var(ddof=1), blocks - 1
            variance = ALIKE * (variance / blocks + variance**2 / (2 * degrees))
        if of_source is not None:
            n, logs = len(of_source), np.log(power_of(of_source, *which))
            error = (logs.var(ddof=1) * (1 + 1 / n)) ** 0.5
            if abs(np.log(power.mean()) - logs.mean()) <= scipy.special.stdtrit(n - 1, (1 + USUAL) / 2) * error:
                variance, degrees = logs.var(ddof=1), n - 1
        away = scipy.special.stdtrit(degrees, (1 + LEVEL) / 2) * np.sqrt(variance / 2)  # of two flights' RMSE
        rmse = np.sqrt(power.mean())
        return float(rmse), float(rmse * np.exp(-away)), float(rmse * np.exp(away))

    horizons = range(2 if seconds[1] > seconds[0] else 1)
    parts = [(one.name, part, one.scale / (one.size if one.uniform else 1) ** 0.5) for part, one in space.parts]
    return {f"{seconds[i]:g} s": {name: around(*which, i) for name, *which in parts} for i in horizons}


def lines_of(expected: Expected, units: Mapping[str, str]) -> list[str]:
    def text(name: str, value: float, low: float, high: float) -> str:
        around = f"{low:.2g} to {high:.2g}" if high < FAR * value else NO_INTERVAL
        return f"{name} {value:.3g} ({around}) {units[name]}".rstrip()

    texts = {horizon: [text(name, *errors) for name, errors in found.items()] for horizon, found in expected.items()}
    return [f"  after {horizon}: {', '.join(found)}" for horizon, found in texts.items()]


def errors_at_ends(
    field: AbstractVectorField, block: Trajectories, counted: Bool[Array, " m"], solver: Solver = None
) -> Float[Array, "2 d"]:
    """Return the mean squared error of each state at the end of single windows and of joined windows.

    It is NaN for a state that was not measured at any of these ends.
    """

    def one(carry, item):
        end, recorded = carry
        window, counted, i = item
        touches = counted & jnp.all(window.x0 == recorded) & (i % JOINED > 0)
        begin = jnp.stack([window.x0, jnp.where(touches, end, window.x0)])
        alone, joined = jax.vmap(lambda x0: rollout(field, x0, window.u, block.dt, compact(solver))[-1])(begin)
        square = jnp.square(errors_of(jnp.stack([alone, joined]), window.x[-1]))
        return (joined, window.x[-1]), (jnp.where(jnp.isnan(square), jnp.inf, square), touches)

    nowhere = jnp.full_like(block.x0[0], jnp.nan)  # touches nothing
    _, (ends, touches) = jax.lax.scan(one, (nowhere, nowhere), (block, counted, jnp.arange(len(counted))))
    last = counted & ~jnp.roll(touches, -1).at[-1].set(False)  # the end of each chain
    weights = jnp.stack([counted, last], axis=1)[..., None] & ~jnp.isnan(block.x[:, -1:])
    return jnp.sum(jnp.where(weights, ends, 0), axis=0) / jnp.sum(weights, axis=0)


@jit_by_size(UNOPTIMISED)
def errors_of_units(
    larger: AbstractVectorField,
    thetas: Float[Array, "b p"],
    changes: Float[Array, "b w"],
    train: Trajectories,
    units: tuple[Int[np.ndarray, "b m"], Bool[np.ndarray, "b m"]],
    solver: Solver,
) -> Float[Array, "b 2 d"]:
    """Compute `errors_at_ends` of each left-out unit, with its own parameters and change of the network."""
    unravel = ravel_parameters(larger)[1]

    def one(unit):
        theta, change, windows, counted = unit
        field = unravel(theta)
        return errors_at_ends(anchored.with_change(field, change) if change.size else field, windows, counted, solver)

    own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[units[0]], train)
    return jax.lax.map(one, (thetas, changes, own, jnp.asarray(units[1])))


def no_higher(after: Float[Array, "b 2 d"], before: Float[Array, "b 2 d"], scale: Scale) -> Bool[Array, ""]:
    """Return whether a change does not raise the mean log-error at the ends of joined windows of left-out units.

    Windows may be too short to show that a change is wrong: a constant force, for example, explains a slow oscillation
    within each. See `errors_at_ends`; log-errors are limited as in `selection.surely`.
    """
    after, before = (
        jnp.nansum(each[:, 1] / (1.0 if scale is None else jnp.square(scale)), axis=-1) for each in (after, before)
    )
    return jnp.mean(jnp.clip(jnp.nan_to_num(jnp.log(before / after)), -MOST, MOST)) >= 0


def longest_chain(windows: Trajectories, blocks: tuple[Int[np.ndarray, "b m"], Bool[np.ndarray, "b m"]]) -> int:
    """Return the largest number of adjacent windows that are joined in one of the blocks, see `blocks_of`."""
    x0, x, longest = np.asarray(windows.x0), np.asarray(windows.x), 1
    for places, counted in zip(*blocks, strict=True):
        own = places[counted]
        touches = (x0[own[1:]] == x[own[:-1], -1]).all(axis=1)
        length = 1
        for i, touch in enumerate(touches, 1):
            length = length + 1 if touch and i % JOINED else 1
            longest = max(longest, length)
    return longest
