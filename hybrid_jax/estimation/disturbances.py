"""Learn to predict a disturbance from its own past, and estimate its hidden state from measured states."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy  # not scipy.signal, which takes a second: it is imported where it is first used
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.dynamics.hidden import DisturbanceModel
from hybrid_jax.dynamics.window_checks import check_windows
from hybrid_jax.estimation.least_squares import Solver
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.runtime import FASTEST_COMPILE, UNOPTIMISED, jit_with
from hybrid_jax.trajectories import Trajectories, windows_of

FILTERS = 5, 20, 60  # time constants, in intervals
PENALTIES = 0.03, 0.1, 0.3, 1.0, np.inf  # on changes of scaled weights; with the last, they do not change
CHUNK = 512  # intervals that are compared at once
PARTS, WINDOWS = 3, 200  # parts that are left out in turn, and windows of each part that compare penalties


def fit_disturbance(
    field: AbstractVectorField, sequences: Sequence[Trajectories], *, steps: int = 10, solver: Solver = None
) -> DisturbanceModel:
    """Learn to predict the disturbance that a field lacks, by ridge regression on its errors after one interval.

    You should use it if the errors of a model last, because the system has states that you do not measure. The penalty
    is chosen by cross-validation over parts of the sequences; an infinite one leaves the predictions unchanged. If you
    pass a model that was learned before, its weights change only if this explains, in each left-out part, more than
    twice as much of the errors as it alters predictions of the earlier data (after Mallows, 1973). For example, noise
    in a hover does not change them.

    To predict from the last state of each window:

        model = hj.fit_disturbance(result.field, flights)
        state = hj.observe(model, past)[:, -1]
        x = hj.rollout_batch(model, state, u, dt)[..., :d]

    Args:
        field: the field, or a `DisturbanceModel` that was learned before.
        sequences: long windows, each without a gap. With one or two, parts of them are left out.
        steps: number of intervals after which predictions are compared.
        solver: of diffrax, by default `RK4`.

    Raises:
        ValueError: if there is no sequence, or one is shorter than twice the steps.
    """
    before = field if isinstance(field, DisturbanceModel) else None
    field = field if before is None else before.field
    flights = _parts(field, sequences, steps)
    places = _states(field, flights[0])
    taus = tuple(k * flights[0].dt for k in FILTERS) if before is None else before.time_constants
    e = state_space(field, flights[0].x0.shape[-1]).tangent_size
    features = e * len(taus) + len(places) + 1
    start = before or DisturbanceModel(field, jnp.zeros((e, features)), jnp.ones(features), taus, places)
    seen = [_observed(start, one, solver)[0] for one in flights]
    errors = [errors_after_one(field, one, solver)[0] for one in flights]
    if before is None:
        start = eqx.tree_at(lambda model: model.sizes, start, _sizes(start, np.concatenate(seen)))

    def joined(of: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        return np.concatenate([seen[i][:-1] for i in of]), np.concatenate([errors[i] for i in of])

    scores, supports = [], []
    for group in (range(i, len(flights), PARTS) for i in range(PARTS)):
        weights = _solved(start, *joined([i for i in range(len(flights)) if i not in group]))
        scores.append(_scores(start, weights, [(seen[i], flights[i]) for i in group], steps, solver))
        supports.append(_support(start, weights, *joined(group)))
    allowed = np.min(supports, axis=0) >= 0 if before else True
    best = int(np.argmin(np.where(allowed, np.mean(scores, axis=0), np.inf)))
    chosen = jnp.asarray(_solved(start, *joined(range(len(flights))))[best])
    return eqx.tree_at(lambda model: model.weights, start, chosen)


def observe(model: DisturbanceModel, past: Trajectories, solver: Solver = None) -> Float[np.ndarray, "n t+1 d+f"]:
    """Return the states of a model (x, z₁, …, z_k) at the start and after each interval, from measured states x.

    Args:
        model: as returned by `fit_disturbance`.
        past: measured windows; you get a warning if they are shorter than the slowest time constant, since the filters
            start at zero.
        solver: of diffrax, by default `RK4`.
    """
    seconds, needed = past.horizon * past.dt, max(model.time_constants, default=0.0)
    if seconds < needed:
        checks.warn(f"past: {seconds:.3g} s are too short for filters of up to {needed:.3g} s")
    return _observed(model, past, solver)


def _observed(model: DisturbanceModel, past: Trajectories, solver: Solver) -> Float[np.ndarray, "n t+1 d+f"]:
    errors = errors_after_one(model.field, past, solver)
    shares = [-np.expm1(-past.dt / tau) for tau in model.time_constants]
    filtered = np.concatenate([scipy.signal.lfilter([a], [1, a - 1], errors, axis=1) for a in shares], axis=-1)
    x = np.concatenate([past.x0[:, None], past.x], axis=1)
    return np.concatenate([x, np.pad(filtered, ((0, 0), (1, 0), (0, 0)))], axis=-1).astype(x.dtype)


def errors_after_one(
    field: AbstractVectorField, past: Trajectories, solver: Solver = None
) -> Float[np.ndarray, "n t e"]:
    """Return a field's error after each interval, over its length [s], in the tangent space of the state."""
    before = np.concatenate([past.x0[:, None], past.x[:, :-1]], axis=1)
    n, t, _ = before.shape
    count = -(-n * t // CHUNK) * CHUNK  # so that all sequences share a program
    flat = (part.reshape(n * t, part.shape[-1]) for part in (before, past.u, past.x))
    rows = [np.resize(each, (count, each.shape[-1])) for each in flat]
    parts = [_one_step(field, [row[i : i + CHUNK] for row in rows], past.dt, solver) for i in range(0, count, CHUNK)]
    return np.concatenate(parts)[: n * t].reshape(n, t, -1)


@jit_with(FASTEST_COMPILE)
def _one_step(field, rows: Any, dt: float, solver: Solver) -> Float[Array, "n e"]:
    x, u, after = rows
    space = state_space(field, x.shape[-1])
    return jax.vmap(space.difference)(after, rollout_batch(field, x, u[:, None], dt, solver)[:, 0]) / dt


def _parts(field: AbstractVectorField, sequences: Sequence[Trajectories], steps: int) -> list[Trajectories]:
    """Check the sequences and split them into at least PARTS sequences of one window each."""
    checks.count("steps", steps)
    found = [
        each[i : i + 1]
        for j, each in enumerate(checks.list_of("sequences", sequences, Trajectories))
        for i in range(len(check_windows(field, each, f"sequences[{j}]")))
    ]
    if len(found) < PARTS:
        pieces = -(-PARTS // len(found))
        found = [piece[i : i + 1] for one in found for piece in [_cut(one, pieces)] for i in range(len(piece))]
    shortest = min(one.horizon for one in found)
    if shortest < 2 * steps:
        raise ValueError(f"sequences: each needs at least {2 * steps} intervals, but one has {shortest}")
    return found


def _cut(one: Trajectories, pieces: int) -> Trajectories:
    """Cut one long window into pieces, unless it is too short."""
    states, u = np.concatenate([one.x0, one.x[0]]), np.asarray(one.u[0])
    return windows_of(states, u, one.dt, steps=one.horizon // pieces) if one.horizon >= pieces else one


def _states(field: AbstractVectorField, windows: Trajectories) -> tuple[int, ...]:
    """Return the states that the field depends on; for example, a vehicle's position does not affect its motion."""
    x, u = (np.resize(np.asarray(part[0]), (CHUNK, part.shape[-1])) for part in (windows.x, windows.u))
    slope = _slopes(field, x, u)
    return tuple(np.flatnonzero(np.abs(np.asarray(slope)).max(axis=(0, 1)) > 0).tolist())


@jit_with(UNOPTIMISED)
def _slopes(field, x, u) -> Float[Array, "n d d"]:
    return jax.vmap(jax.jacfwd(field))(x, u)


def _features(model: DisturbanceModel, states: np.ndarray) -> Float[np.ndarray, "n f"]:
    own, filtered = np.split(states, [states.shape[1] - model.hidden], axis=1)
    bands = -np.diff(filtered.reshape(len(states), -1, len(model.weights)), axis=1, append=0)
    parts = bands.reshape(filtered.shape), own[:, list(model.states)], np.ones((len(states), 1))
    return np.concatenate(parts, axis=1)


def _sizes(model: DisturbanceModel, states: np.ndarray) -> Float[Array, " f"]:
    d, e = states.shape[1] - model.hidden, len(model.weights)
    fastest = np.sqrt(np.mean(np.square(states[:, d : d + e]), axis=0)) + 1e-12
    varied = states[:, list(model.states)].std(axis=0)
    sizes = [*[fastest] * len(model.time_constants), np.where(varied > 1e-9, varied, np.inf), [1.0]]
    return jnp.asarray(np.concatenate(sizes), model.weights.dtype)


def _solved(start: DisturbanceModel, states: np.ndarray, errors: np.ndarray) -> Float[np.ndarray, "penalties e f"]:
    """Fit weights by ridge regression on scaled features, with each penalty on the change from the start's weights."""
    before, sizes = np.asarray(start.weights, float), np.asarray(start.sizes, float)
    features, scale = _features(start, states), sizes[: len(before)]
    scaled, goals = features / sizes, (errors - features @ before.T) / scale
    gram, right, every = scaled.T @ scaled, scaled.T @ goals, np.eye(scaled.shape[1])
    finite = (np.linalg.solve(gram + penalty * len(scaled) * every, right) for penalty in PENALTIES[:-1])
    changes = [*(each / sizes[:, None] * scale for each in finite), np.zeros_like(right)]
    return (before + np.swapaxes(changes, 1, 2)).astype(start.weights.dtype)


def _support(
    start: DisturbanceModel, weights: Float[np.ndarray, "penalties e f"], states: np.ndarray, errors: np.ndarray
) -> Float[np.ndarray, " penalties"]:
    """Return the mean squared error that weights explain, less twice what they alter on the earlier data."""
    sizes = np.where(np.isinf(start.sizes), 0.0, start.sizes)
    scale, features = sizes[: len(start.weights)], _features(start, states)
    change = (weights - np.asarray(start.weights)) / scale[:, None]
    off = (errors - features @ np.asarray(start.weights).T) / scale
    explained = np.square(off) - np.square(off - features @ np.swapaxes(change, 1, 2))
    return explained.sum(axis=-1).mean(axis=-1) - 2 * np.square(change * sizes).sum(axis=(1, 2))


def _scores(start: DisturbanceModel, weights, flights: Sequence, steps: int, solver: Solver) -> np.ndarray:
    """Return for each weights the mean log squared error after `steps` intervals, over quantities of the state."""
    cut = [windows_of(seen, np.asarray(one.u[0]), one.dt, steps=steps, stride=1) for seen, one in flights]
    x0, u, end = (np.concatenate(parts) for parts in zip(*((w.x0, w.u, w.x[:, -1]) for w in cut), strict=True))
    chosen = np.round(np.linspace(0, len(x0) - 1, WINDOWS)).astype(int)
    dt, space = cut[0].dt, state_space(start.field, x0.shape[1] - start.hidden)
    windows = [part[chosen] for part in (x0, u, end)]
    found = [_squares(start, each, windows, dt, solver) for each in weights]
    sizes = np.cumsum([one.tangent_size for one in space.quantities])[:-1]
    of_quantity = np.stack([each.sum(axis=1) for each in np.split(np.asarray(found, float), sizes, axis=1)])
    return np.nan_to_num(np.log(of_quantity).mean(axis=0), nan=np.inf)


@jit_with(FASTEST_COMPILE)
def _squares(model, weights, windows: Any, dt: float, solver: Solver) -> Float[Array, " e"]:
    """Return the mean squared error of each number of the state at the end of windows."""
    x0, u, end = windows
    model = eqx.tree_at(lambda each: each.weights, model, weights)
    d = x0.shape[-1] - model.hidden
    reached = rollout_batch(model, x0, u, dt, solver)[:, -1, :d]
    return jnp.mean(jnp.square(jax.vmap(state_space(model.field, d).difference)(reached, end[:, :d])), axis=0)
