"""`fit`: train one field on windows. The host runs the compiled loop of `fitting` in blocks of epochs."""

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.io.models import check_savable
from hybrid_jax.networks.standardise import with_scaling
from hybrid_jax.training.fitting import (
    ADAM,
    RUNNING,
    STATUS_NAMES,
    FitState,
    Optimiser,
    RunConfig,
    make_run_config,
    run_recorded,
    start,
)
from hybrid_jax.training.objective import AbstractTrajectoryLoss, Learner, Settings, prepared
from hybrid_jax.trajectories import Trajectories, check

WEIGHT = 1e-3  # λ, where none is given
RATE = 1e-2
BLOCK, BLOCK_SECONDS = 200, 0.5  # most epochs of a block, and how long it should take

Report = Callable[[int, FitState], object]
Shared = tuple[PyTree, Settings, Optimiser]  # validation data as prepared by the objective, …


class History(eqx.Module):
    """The losses of every epoch."""

    train: Float[np.ndarray, " epochs"]
    validation: Float[np.ndarray, " epochs"]


class FitResult(eqx.Module):
    """A finished training run.

    Attributes:
        state: the final state of the run.
        history: training and validation loss of every epoch.
        status: "ok" (stopped early), "capped" (by max_epochs), "diverged", or "running" if it was interrupted.
    """

    state: FitState
    history: History
    status: str

    @property
    def best(self) -> Learner:
        """The field of the best validation epoch."""
        return self.state.best

    @property
    def best_mse(self) -> Float[Array, ""]:
        """The validation loss of `best`."""
        return self.state.best_mse

    @property
    def best_epoch(self) -> int:
        """The epoch of `best`, counted from 1; 0 if it is the initial field."""
        return int(self.state.best_epoch)

    @property
    def field(self) -> Learner:
        """The field after the last epoch."""
        return self.state.field

    @property
    def epochs(self) -> int:
        """The number of epochs."""
        return int(self.state.epoch)


class FitInterrupted(KeyboardInterrupt):
    """Ctrl-C during `fit`. `result` holds the run up to the last complete block of epochs."""

    def __init__(self, result: FitResult):
        super().__init__(f"training was interrupted after epoch {result.epochs}; `result` of this exception holds it")
        self.result = result


def fit(
    field: AbstractVectorField,
    train: Trajectories,
    validation: Trajectories,
    key: PRNGKeyArray,
    *,
    rates: PyTree = None,
    optimiser: Optimiser | None = None,
    min_epochs: int = 100,
    patience: int = 20,
    max_epochs: int = 2000,
    regulariser_weight: float | None = None,
    settings: Settings | None = None,
    progress: Report | bool | None = None,
) -> FitResult:
    """Train a field on all windows of `train`; `result.best` is the field of the best validation epoch.

    A network made without a scaling is scaled by the training windows first; see `with_scaling`.

    Args:
        key: of the order of the minibatches.
        rates: learning rates of Adam, a tree prefix of the field: a number, by default 1e-2, or e.g.
            `Hybrid(1e-2, 1e-3)` for physics and residual.
        optimiser: any Optax optimiser in place of Adam, e.g. `optax.adamw(1e-3)`. `rates` then multiply its updates,
            and are 1 by default.
        min_epochs: no early stop before this many epochs.
        patience: stop after this many epochs without a better validation loss.
        max_epochs: stop after this many epochs.
        regulariser_weight: λ, by default 1e-3.
        settings: by default minibatches of 100 windows, or of all if there are fewer, and no regulariser. The paper's
            is `Settings(regulariser=hybrid_jax.training.loss.trajectory_correlation)`.
        progress: True for a progress bar on stderr, or a function of (epoch, state) that is called about twice a
            second.

    Raises:
        ValueError: windows that the objective refuses, that do not match the field, or are of a rigid body and have no
            unit quaternions; fewer training windows than a minibatch; minibatches of one window that are normalised by
            themselves; a batch norm that cannot be trained; a field with nothing to learn; rates that do not match the
            field; a weight without a regulariser; another argument out of range.
        FitInterrupted: Ctrl-C; a KeyboardInterrupt that holds the result so far.
    """
    data, shared, weight = checked_arguments(field, train, validation, key, settings, optimiser, regulariser_weight)
    if rates is None:
        rates = RATE if optimiser is None else 1.0
    rates = _of_each(rates, eqx.filter(field, trainable(field)))
    make_run_config(rates, 0, 0, min_epochs, patience, max_epochs, weight)  # refuses before the field is evaluated
    field = ready(field, train)
    rates = jax.tree.structure(eqx.filter(field, trainable(field))).unflatten(rates)
    plan = make_run_config(rates, jnp.arange(len(data)), len(data), min_epochs, patience, max_epochs, weight)
    return drive(start(field, key, shared[-1]), plan, data, shared, progress)


def checked_arguments(
    field: Learner,
    train: Trajectories,
    validation: Trajectories,
    key: PRNGKeyArray,
    settings: Settings | None,
    optimiser: Optimiser | None,
    weight: float | None,
) -> tuple[PyTree, Shared, float]:
    """The training data, what is shared by all stages, and λ: the arguments of `fit`, checked, with their defaults."""
    if settings is None:
        settings = Settings(batch_size=min(Settings.batch_size, len(check(train, "train"))))
    data, validated_on = prepared(field, train, validation, key, settings)
    if not isinstance(optimiser, Optimiser | None):
        raise ValueError(f"optimiser must be an optax.GradientTransformation, got {checks.short_repr(optimiser)}")
    if weight is not None and settings.regulariser is None and isinstance(settings.objective, AbstractTrajectoryLoss):
        raise ValueError(
            f"regulariser_weight is {checks.short_repr(weight)} but settings.regulariser is None; leave it out, or "
            "take one of hybrid_jax.training.loss.REGULARISERS"
        )
    shared = validated_on, settings, ADAM if optimiser is None else _negated(optimiser)
    return data, shared, WEIGHT if weight is None else weight


def _of_each(rates: PyTree, learned: Learner) -> list:
    """The rate of each learned array; a list, as the tree changes when the field is scaled."""
    try:
        return jax.tree.leaves(jax.tree.map(lambda rate, part: jax.tree.map(lambda _: rate, part), rates, learned))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"rates must be a number, or a tree of them that begins as the field does, got {checks.short_repr(rates)}"
        ) from error


def ready(field: Learner, train: Trajectories) -> Learner:
    """The field with its scaling set. Warns if a file of it could not be loaded without more information."""
    reason = check_savable(field)
    if reason is not None:
        warnings.warn(reason, stacklevel=3)
    return with_scaling(field, train) if isinstance(field, AbstractVectorField) else field


def drive(state: FitState, plan: RunConfig, data: PyTree, shared: Shared, progress: Report | bool | None) -> FitResult:
    """Take a run to its end in blocks of epochs, and report the progress between them."""
    validated_on, settings, optimiser = shared
    # Weakly typed numbers would come back typed, and the second block be compiled anew.
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype) if eqx.is_array(leaf) else leaf, state)
    losses, most = [np.zeros((0, 2))], 1
    empty = jnp.zeros((BLOCK, 2))
    with _reporting(progress, int(plan.max_epochs)) as report:
        try:
            while int(state.status) == RUNNING:
                began, first = time.perf_counter(), int(state.epoch)
                until = jnp.asarray(first + most, jnp.int32)  # an array, so that one program serves all blocks
                after, rows = _block(state, empty, plan, data, validated_on, settings, until, optimiser)
                rows = np.asarray(rows)
                state, losses = after, [*losses, rows[: int(after.epoch) - first]]
                report(int(state.epoch), state)
                most = int(np.clip(most * BLOCK_SECONDS / (time.perf_counter() - began), 1, min(BLOCK, 4 * most)))
        except KeyboardInterrupt as interrupt:
            raise FitInterrupted(_result(state, losses)) from interrupt
    return _result(state, losses)


_block = eqx.filter_jit(run_recorded)


def _result(state: FitState, losses: list[np.ndarray]) -> FitResult:
    return FitResult(state, History(*np.concatenate(losses).T), STATUS_NAMES[int(state.status)])


@cache  # the same object for the same optimiser, so that its program is compiled once
def _negated(optimiser: Optimiser) -> Optimiser:
    """The optimiser with updates that are subtracted, as those of `fitting`, rather than added."""
    return optax.chain(optimiser, optax.scale(-1.0))


@contextmanager
def _reporting(progress: Report | bool | None, most: int) -> Iterator[Report]:
    if not progress:
        yield lambda epoch, state: None
    elif callable(progress):
        yield progress
    else:
        columns = TextColumn("epoch"), MofNCompleteColumn(), BarColumn(), TextColumn("{task.description}")
        clocks = TimeElapsedColumn(), TextColumn("at most"), TimeRemainingColumn()
        with Progress(*columns, *clocks, console=Console(stderr=True)) as bar:
            task = bar.add_task("compiling", total=most)

            def show(epoch: int, state: FitState) -> None:
                bar.update(task, completed=epoch, description=f"best validation loss {float(state.best_mse):.3g}")

            yield show
