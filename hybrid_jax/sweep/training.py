"""Many training runs as one compiled program: every seed, size and rate is a lane (see lanes.py)."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.estimation.discretisation import compare_steps
from hybrid_jax.metrics import window_mse
from hybrid_jax.runtime import FAST_COMPILE, entry
from hybrid_jax.status import Status
from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.lanes import LaneMap, count, lane, load_balance
from hybrid_jax.training import fitting
from hybrid_jax.training.fitting import FitState, RunConfig
from hybrid_jax.training.objective import Settings, TrajectoryLoss, check_minibatch, compiler_options
from hybrid_jax.trajectories import Trajectories

FIRST_BLOCK = 5  # epochs; later blocks are sized by the clock
PROGRAMS = 16  # compiled programs kept in memory, to train and to evaluate


@dataclass(frozen=True)
class Progress:
    """The state of a sweep after a block of epochs.

    Attributes:
        active: number of lanes that are still training.
        lanes: number of all lanes.
        epochs: largest number of epochs that a lane has completed.
        best: smallest validation L_MSE of any lane.
        at_least: number of epochs that some active lane still needs.
        at_most: number of epochs that some active lane may still need.
        seconds: time since the sweep began [s].
    """

    active: int
    lanes: int
    epochs: int
    best: float
    at_least: int
    at_most: int
    seconds: float


@entry
def sweep(
    states: FitState,
    plans: RunConfig,
    train: Trajectories,
    validation: Trajectories,
    settings: Settings,
    *,
    min_capacity: tuple[int, int] = (0, 0),
    width: int | None = None,
    block_seconds: float = 4.0,
    on_block: Callable[[FitState, Progress], None] | None = None,
) -> FitState:
    """Train each lane until it stops. If all have stopped already, the program is compiled and nothing is trained.

    You get a warning if half the solver's step would change the lane with the best validation loss, as in `fit`.

    Args:
        validation: windows for early stopping, shared by all lanes.
        settings: see `fit`; the same for all lanes.
        states: stacked initial states, one for each lane (`fitting.start`, `lanes.stack`).
        plans: stacked run configurations, one for each lane.
        train: the windows that `plans` index into, shared by all lanes.
        min_capacity: the smallest numbers of lanes and training windows to compile for. Smaller sweeps are padded and
            share the program; padding of lanes needs a fixed width (see `LaneMap`).
        width: number of lanes in a chunk; see `LaneMap`. You should lower it if a GPU has too little memory.
        block_seconds: approximate duration of a block of epochs, after which finished lanes are dropped.
        on_block: a function that is called after each block with all states and the progress.

    Returns:
        The stacked final states as host arrays. A lane whose loss was not finite has status DIVERGED and its best epoch
        before; it does not affect other lanes. Rounding may depend on a lane's place in a chunk, which can change when
        others stop.

    Raises:
        ValueError: if data are invalid, n_train does not fit them, or a BatchNorm has minibatches of one window.
    """
    states, plans = jax.device_get((states, plans))
    shared = settings.objective.prepare(train, "train"), settings.objective.prepare(validation, "validation")
    check_minibatch(states.field, settings)
    _check(plans, *shared, settings)
    plans, shared = _padded(plans, shared, min_capacity[1])
    shapes = _shapes(lane((states, plans), 0), shared)
    options = compiler_options(lane(states.field, 0), shared[0], settings)
    block = _block(settings, tuple(options.items()), width, max(count(states), min_capacity[0]), shapes)
    costs = np.asarray(plans.n_train) + len(shared[1]) / 8  # a validation window costs an eighth of a training window
    none = np.zeros(len(costs), np.int32)
    block((states, plans, none), shared, costs, range(len(costs)))  # compiles, trains nothing
    more, began, trains = FIRST_BLOCK, time.perf_counter(), np.any(states.status == Status.RUNNING)
    while len(active := np.flatnonzero(states.status == Status.RUNNING)):
        start = time.perf_counter()
        # A device with less work than the busiest trains its lanes for more epochs, so that none is idle.
        shards, chunk, _ = block.schedule(len(costs), costs, active)
        epochs = (more * load_balance(shards, costs, chunk)).astype(np.int32)
        states = _merge(states, active, block((states, plans, epochs), shared, costs, active))
        if on_block is not None:
            on_block(states, _progress(states, plans, time.perf_counter() - began))
        more = hosts.agreed(int(np.clip(more * block_seconds / (time.perf_counter() - start), 1, 4 * more)))
    if trains and isinstance(settings.objective, TrajectoryLoss):
        field, plan, mse = lane((states.best, plans, states.best_mse), int(np.argmin(states.best_mse)))
        own, scale = train[plan.subset[: plan.n_train]], settings.objective.divisor()
        if np.isfinite(mse):
            compare_steps(field, own, settings.solver, scale)
    return states


@entry
def evaluate(
    fields: AbstractVectorField, windows: Trajectories, every: int, settings: Settings, min_lanes: int = 0
) -> Float[np.ndarray, " lanes"]:
    """Compute L_MSE of each lane's field in inference mode.

    Args:
        fields: stacked fields, one for each lane.
        windows: the windows to predict, shared by all lanes.
        every: number of intervals from one compared state to the next.
        settings: settings with the solver.
        min_lanes: the smallest number of lanes to compile for.
    """
    return evaluate_windows(fields, windows, every, settings, min_lanes)[0]


def evaluate_windows(
    fields: AbstractVectorField, windows: Trajectories, every: int, settings: Settings, min_lanes: int = 0
) -> tuple[Float[np.ndarray, " lanes"], Float[np.ndarray, "lanes windows"]]:
    """Return `evaluate` and the error of each window, whose mean it is."""
    lanes = count(fields := jax.device_get(fields))
    errors = _evaluation(settings, every, max(lanes, min_lanes), _shapes(lane(fields, 0), windows))
    return errors(fields, (windows,), np.ones(lanes), range(lanes))


def _padded(plans: RunConfig, shared: tuple[PyTree, PyTree], windows: int) -> tuple[RunConfig, tuple[PyTree, PyTree]]:
    """Pad plans and training data to a number of windows; no plan uses the padding."""
    train, validation = shared
    subset = np.pad(plans.subset, ((0, 0), (0, max(0, windows - plans.subset.shape[-1]))))
    if len(train) < windows:
        train = train[np.minimum(np.arange(windows), len(train) - 1)]
    return replace(plans, subset=subset), (train, validation)


def _shapes(*trees: PyTree) -> tuple:
    leaves = [leaf for leaf in jax.tree.leaves(trees) if eqx.is_array(leaf)]
    return (*((leaf.shape, leaf.dtype) for leaf in leaves), jax.tree.structure(trees))


# A later sweep of the same shapes compiles nothing. One map per shape, so that unused programs are freed.
@lru_cache(PROGRAMS)
def _block(settings: Settings, options: tuple, width: int | None, lanes: int, shapes: tuple) -> LaneMap:
    return LaneMap(partial(_trained, settings), width, min_capacity=lanes, compiler=dict(options))


def _trained(settings: Settings, lane: tuple[FitState, RunConfig, Int[Array, ""]], train, validation) -> FitState:
    state, plan, epochs = lane
    return fitting.run(state, plan, train, validation, settings, state.epoch + epochs)[0]


@lru_cache(PROGRAMS)
def _evaluation(settings: Settings, every: int, lanes: int, shapes: tuple) -> LaneMap:
    return LaneMap(partial(_errors, settings, every), min_capacity=lanes, compiler=FAST_COMPILE)


def _errors(
    settings: Settings, every: int, field: AbstractVectorField, windows: Trajectories
) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    each = window_mse(field, windows, every, settings.solver)
    return jnp.mean(each), each


def _merge(states: FitState, active: np.ndarray, after: PyTree) -> FitState:
    def put(old, new):
        old = np.array(old)
        old[active] = new
        return old

    arrays, rest = eqx.partition(states, eqx.is_array)
    return eqx.combine(jax.tree.map(put, arrays, after), rest)


def _progress(states: FitState, plans: RunConfig, seconds: float) -> Progress:
    running = np.asarray(states.status == Status.RUNNING)
    at_most = plans.max_epochs - states.epoch
    at_least = np.maximum(plans.min_epochs, states.best_epoch + plans.patience) - states.epoch
    return Progress(
        active=int(running.sum()),
        lanes=len(running),
        epochs=int(states.epoch.max()),
        best=float(np.min(states.best_mse)),
        at_least=int(np.max(np.minimum(at_least, at_most), where=running, initial=0)),
        at_most=int(np.max(at_most, where=running, initial=0)),
        seconds=seconds,
    )


def _check(plans: RunConfig, train: PyTree, validation: PyTree, settings: Settings) -> None:
    batch, listed = settings.batch_size, plans.subset.shape[-1]
    for size in np.unique(plans.n_train):
        if not batch <= size <= min(listed, len(train)):
            windows = f"the number of windows: {len(train)} in train, {listed} in subset"
            raise ValueError(f"n_train={size} must lie between batch_size={batch} and {windows}")
    # A gather would clamp such an index and silently use another window.
    for name, split, windows in (("subset", "train", train), ("validate_on", "validation", validation)):
        index = np.asarray(getattr(plans, name) if getattr(plans, name) is not None else (), int)
        outside = index[(index < 0) | (index >= len(windows))]
        if outside.size:
            words = f"which is not an index of the {len(windows)} windows of {split}"
            raise ValueError(f"{name} contains {outside[0]}, {words}")
