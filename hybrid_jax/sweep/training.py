"""Many training runs as one compiled program: every seed, size and rate is a lane (see lanes.py).

A host loop takes the active lanes through blocks of epochs. Between two blocks it drops the lanes that have stopped,
so that these cost nothing, reports progress, and is where a run can be interrupted.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.runtime import FAST_COMPILE
from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.lanes import LaneMap, count, lane
from hybrid_jax.training import fitting
from hybrid_jax.training.fitting import FitState, RunConfig
from hybrid_jax.training.objective import Settings, check_minibatch
from hybrid_jax.trajectories import Trajectories

FIRST_BLOCK = 5  # epochs; later blocks are sized by the clock
PROGRAMS = 16  # of a kind that are kept: more than an experiment needs, and a bound on a long process's memory


@dataclass(frozen=True)
class Room:
    """What a program has places for, so that sweeps of less share it; a sweep of more has a program of its own.

    Attributes:
        lanes: where a chunk is of a fixed width (see `LaneMap`).
        windows: of training.
    """

    lanes: int = 0
    windows: int = 0


NO_MORE = Room()  # than is asked for


@dataclass(frozen=True)
class Progress:
    """What a sweep knows after a block of epochs.

    Attributes:
        active: lanes still training.
        lanes: all lanes.
        epochs: the most epochs that a lane has completed.
        best: the smallest validation L_MSE of any lane.
        longest: epochs that the active lanes may still need at the most, and need at the least.
        seconds: since the sweep began.
    """

    active: int
    lanes: int
    epochs: int
    best: float
    at_least: int
    at_most: int
    seconds: float


def sweep(
    states: FitState,
    plans: RunConfig,
    train: Trajectories,
    validation: Trajectories,
    settings: Settings,
    *,
    room: Room = NO_MORE,
    width: int | None = None,
    block_seconds: float = 4.0,
    on_block: Callable[[FitState, Progress], None] | None = None,
) -> FitState:
    """Take every lane to its end.

    Args:
        states: stacked starts, one a lane (`training.start`, `lanes.stack`).
        plans: stacked plans, one a lane.
        train: the windows that plans index into; shared by all lanes.
        room: that the program has at the least.
        width: lanes in a chunk; see `LaneMap`.
        on_block: called after each block with all states and the progress.

    Returns:
        The stacked final states as host arrays, in the order given. A lane whose loss was not finite has status
        DIVERGED and the best epoch that it had; it changes no other lane.

    Raises:
        ValueError: bad data, a plan that asks for more windows than `train` has or for less than a minibatch, or a
            minibatch of one window where fields normalise it.
    """
    states, plans = jax.device_get((states, plans))
    plans, block, shared, costs = _ready(states, plans, train, validation, settings, room, width)
    more, began = FIRST_BLOCK, time.perf_counter()
    while len(active := np.flatnonzero(states.status == fitting.RUNNING)):
        start = time.perf_counter()
        # A device with less to do than the busiest trains its lanes longer, so that none of them waits.
        epochs = np.zeros(len(costs), np.int32)
        epochs[active] = more * block.slack((states, plans, epochs), shared, costs, active)
        states = _merge(states, active, block((states, plans, epochs), shared, costs, active))
        if on_block is not None:
            on_block(states, _progress(states, plans, time.perf_counter() - began))
        more = hosts.agreed(int(np.clip(more * block_seconds / (time.perf_counter() - start), 1, 4 * more)))
    return states


def compile_sweep(
    states: FitState,
    plans: RunConfig,
    train: Trajectories,
    validation: Trajectories,
    settings: Settings,
    room: Room = NO_MORE,
) -> None:
    """Compile what `sweep` of arguments of these shapes would; on another thread, say, while data are being made.

    Raises:
        ValueError: as `sweep`.
    """
    states, plans = jax.device_get((states, plans))
    _ready(states, plans, train, validation, settings, room, None)


def evaluate(
    fields: AbstractVectorField, windows: Trajectories, every: int, settings: Settings, room: Room = NO_MORE
) -> Float[np.ndarray, " lanes"]:
    """L_MSE of each lane's field as deployed, on windows that all lanes share."""
    return _errors(fields, windows, every, settings, room, range(count(fields)))


def compile_evaluation(
    fields: AbstractVectorField, windows: Trajectories, every: int, settings: Settings, room: Room = NO_MORE
) -> None:
    """Compile what `evaluate` of arguments of these shapes would."""
    _errors(fields, windows, every, settings, room, ())


def _errors(fields, windows, every: int, settings: Settings, room: Room, active) -> Float[np.ndarray, " active"]:
    fields = jax.device_get(fields)
    places = max(count(fields), room.lanes)
    errors = _evaluation(settings, every, places, _shapes(lane(fields, 0), windows))
    return errors(fields, (windows,), np.ones(count(fields)), active)


def _ready(
    states: FitState,
    plans: RunConfig,
    train: PyTree,
    validation: PyTree,
    settings: Settings,
    room: Room,
    width: int | None,
) -> tuple[RunConfig, LaneMap, tuple, np.ndarray]:
    """Plans and shared data as the compiled block takes them, that block, and what an epoch of each lane costs."""
    train = settings.objective.prepare(train, "train")
    validation = settings.objective.prepare(validation, "validation")
    check_minibatch(states.field, settings)
    _check(plans, train, settings)
    plans, train = _padded(plans, train, room.windows)
    shared = (train, validation)
    places = max(count(states), room.lanes)
    block = _block(settings, width, places, _shapes(lane((states, plans), 0), shared))
    costs = np.asarray(plans.n_train) + len(validation) / 8  # a forward window costs an eighth of a trained one
    none = np.zeros(len(costs), np.int32)
    block((states, plans, none), shared, costs, range(len(costs)))  # compiles, trains nothing
    return plans, block, shared, costs


def _padded(plans: RunConfig, train: PyTree, windows: int) -> tuple[RunConfig, PyTree]:
    """Plans and data as if there were so many windows; no plan asks for what is added."""
    listed = plans.subset.shape[-1]
    subset = np.pad(plans.subset, ((0, 0), (0, max(windows, listed) - listed)))
    if len(train) < windows:
        train = train[np.minimum(np.arange(windows), len(train) - 1)]
    return replace(plans, subset=subset), train


def _shapes(*trees: PyTree) -> tuple:
    """What a program is compiled for."""
    leaves = [leaf for leaf in jax.tree.leaves(trees) if eqx.is_array(leaf)]
    return (*((leaf.shape, leaf.dtype) for leaf in leaves), jax.tree.structure(trees))


# A sweep of the same shapes, later in the same process, compiles nothing; one map a shape, so that old programs go.
@lru_cache(PROGRAMS)
def _block(settings: Settings, width: int | None, places: int, shapes: tuple) -> LaneMap:
    def block(lane: tuple[FitState, RunConfig, Int[Array, ""]], train, validation) -> FitState:
        state, plan, epochs = lane
        return fitting.run(state, plan, train, validation, settings, state.epoch + epochs)

    return LaneMap(block, width, room=places)


@lru_cache(PROGRAMS)
def _evaluation(settings: Settings, every: int, places: int, shapes: tuple) -> LaneMap:
    def errors(field: AbstractVectorField, windows: Trajectories) -> Float[Array, ""]:
        return rollout_mse(field, windows, every, settings.solver)

    return LaneMap(errors, room=places, compiler=FAST_COMPILE)


def _merge(states: FitState, active: np.ndarray, after: PyTree) -> FitState:
    """All states, the active lanes' replaced."""

    def put(old, new):
        old = np.array(old)
        old[active] = new
        return old

    arrays, rest = eqx.partition(states, eqx.is_array)
    return eqx.combine(jax.tree.map(put, arrays, after), rest)


def _progress(states: FitState, plans: RunConfig, seconds: float) -> Progress:
    running: Bool[Array, " lanes"] = states.status == fitting.RUNNING
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


def _check(plans: RunConfig, train: PyTree, settings: Settings) -> None:
    listed = plans.subset.shape[-1]
    for size in np.unique(plans.n_train):
        if not settings.batch_size <= size <= min(listed, len(train)):
            raise ValueError(
                f"n_train={size} must lie between batch_size={settings.batch_size} and the number of windows: "
                f"{len(train)} in train, {listed} in subset"
            )
    # A gather would clamp such an index and train on another window in silence.
    outside = plans.subset[(plans.subset < 0) | (plans.subset >= len(train))]
    if outside.size:
        raise ValueError(f"subset holds {outside[0]}, which is no index of the {len(train)} windows of train")
