"""`fit`: train one field on windows, by the compiled loop of `fitting` in blocks of epochs."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.dynamics.composition import check_batch_norm
from hybrid_jax.dynamics.outputs import StateSpaceModel, dynamics_of
from hybrid_jax.dynamics.window_checks import check_windows
from hybrid_jax.estimation.discretisation import compare_steps
from hybrid_jax.estimation.record_windows import RecordWindows, states_of
from hybrid_jax.implicit_solvers import solver_errors
from hybrid_jax.integrate import check_callable, checked
from hybrid_jax.io.models import check_savable
from hybrid_jax.networks.standardise import with_motion, with_scaling
from hybrid_jax.runtime import FAST_COMPILE, entry, jit_by_size, keep_programs
from hybrid_jax.status import Status
from hybrid_jax.training import fitting
from hybrid_jax.training.fitting import ADAM, FitState, Optimiser, RunConfig, make_run_config
from hybrid_jax.training.objective import UNSCALED, Learner, Settings, TrajectoryLoss, check_minibatch, compiler_options
from hybrid_jax.training.record_loss import RecordLoss
from hybrid_jax.trajectories import Trajectories, check_like, overflows

WEIGHT = 1e-3  # λ, where none is given
RATE = 1e-2
BLOCK, BLOCK_SECONDS = 200, 0.5  # maximum number of epochs of a block, and its duration

Report = Callable[[int, FitState], object]
Shared = tuple[PyTree, Settings, Optimiser]  # validation data as prepared by the objective, …


class History(eqx.Module):
    """The losses of each epoch.

    Attributes:
        train: the training loss with the regulariser, averaged over the minibatches of each epoch.
        validation: the validation loss after each epoch.
    """

    train: Float[np.ndarray, " epochs"]
    validation: Float[np.ndarray, " epochs"]


class FitResult(eqx.Module):
    """The result of `fit`.

    Attributes:
        best: the field of the best validation epoch.
        best_mse: the validation loss of the best epoch.
        best_epoch: the best epoch, counted from 1; 0 for the initial field.
        field: the field after the last epoch.
        epochs: the number of trained epochs.
        status: how the run ended: OK if it stopped early, STALLED if no epoch was better than the first, RUNNING if you
            interrupted it.
        history: the losses of each epoch.
        state: the final state of the run.
        discretisation: the effect of half the solver's step: without a network, the largest change of a parameter in
            standard errors, else the change of the predictions over their errors. -1 if it was not computed, because
            the run diverged or the objective is not a `TrajectoryLoss`.
    """

    best: Learner
    best_mse: Float[Array, ""]
    best_epoch: int
    field: Learner
    epochs: int
    status: Status
    history: History
    state: FitState
    discretisation: float = -1.0


class FitInterrupted(KeyboardInterrupt):
    """Raised by Ctrl-C during `fit`; `result` has the run up to the last complete block of epochs."""

    def __init__(self, result: FitResult):
        super().__init__(f"training was interrupted after epoch {result.epochs}; this exception has it as `result`")
        self.result = result


@entry
def fit(
    field: Learner,
    train: Trajectories | RecordWindows,
    validation: Trajectories | RecordWindows,
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
    """Train a field by gradient descent with early stopping. `result.best` is the field of the best epoch.

    You get a warning if `discretisation` is above 0.5: a network then learns the error of the solver's steps. If a
    network has no scaling of its inputs, it is computed from the training windows; see `with_scaling`.

    Args:
        field: the initial field, a `StateSpaceModel` for windows of records, or another module that the objective in
            `settings` can evaluate.
        train: the training windows. NaN in x means "not measured" and counts as no error; x0 and u must be finite.
            If only some states are measured, use windows of `estimate_windows`.
        validation: windows that determine the best epoch and early stopping. They should be from other recordings.
        key: random key for shuffling minibatches.
        rates: learning rates of Adam, a tree prefix of the field: one number, by default 1e-2, or for example
            `Hybrid(1e-2, 1e-3)` for physics and residual.
        optimiser: any Optax optimiser instead of Adam, for example `optax.adamw(1e-3)`. `rates` then multiply its
            updates, and are 1 by default.
        min_epochs: training does not stop early before this epoch.
        patience: training stops after this many epochs without a better validation loss. Noisy data need more.
        max_epochs: training stops after this many epochs.
        regulariser_weight: λ, by default 1e-3.
        settings: by default minibatches of 100 windows, or of all if there are fewer, and no regulariser. For the
            paper's, use `Settings(regulariser=hybrid_jax.training.loss.trajectory_correlation)`.
        progress: True for a bar on stderr, or a function of (epoch, state), which is called about twice a second.

    Raises:
        ValueError: if windows are invalid or do not match the field, there are fewer training windows than in a
            minibatch, batch normalisation has minibatches of one window, the field has nothing to learn, rates do not
            match the field, a weight has no regulariser, or another argument is out of range.
        FitInterrupted: if you press Ctrl-C; it has the result so far.
    """
    data, shared, weight = checked_arguments(field, train, validation, key, settings, optimiser, regulariser_weight)
    keep_programs("fit", states_of(train).x.shape)
    if rates is None:
        rates = RATE if optimiser is None else 1.0
    try:
        each = jax.tree.leaves(jax.tree.broadcast(rates, eqx.filter(field, trainable(field))))
    except (TypeError, ValueError) as error:
        expected = "a number, or a tree of numbers that is a prefix of the field"
        raise ValueError(f"rates must be {expected}, got {checks.short_repr(rates)}") from error
    plan = make_run_config(each, np.arange(len(data)), len(data), min_epochs, patience, max_epochs, weight)
    field = ready(field, train)  # scaling changes the tree of the field, but not what is learned
    plan = replace(plan, rates=jax.tree.structure(eqx.filter(field, trainable(field))).unflatten(plan.rates))
    return compared(drive(fitting.start(field, key, shared[-1]), plan, data, shared, progress), data, shared[1])


def checked_arguments(
    field: Learner, train, validation, key, settings: Settings | None, optimiser, weight
) -> tuple[PyTree, Shared, float]:
    """Check the arguments of `fit`; return the training data, what all stages share, and λ."""
    checks.not_traced("fit", field, train, validation, key)
    settings = Settings() if settings is None else settings
    checks.instance("settings", settings, Settings)
    windows = {"train": train, "validation": validation}
    if isinstance(train, RecordWindows) and settings.objective is UNSCALED:
        settings = replace(settings, objective=RecordLoss())
    windows = {n: check_windows(field, w, n, True) if isinstance(w, Trajectories) else w for n, w in windows.items()}
    data, validated_on = (settings.objective.prepare(w, name) for name, w in windows.items())
    _check_field(field, windows, settings)
    checks.key("key", key)
    settings = replace(settings, batch_size=min(settings.batch_size, len(data)))
    check_minibatch(field, settings)
    if not isinstance(optimiser, Optimiser | None):
        raise ValueError(f"optimiser must be an optax.GradientTransformation, got {checks.short_repr(optimiser)}")
    if optimiser is not None:
        moving = eqx.filter(field, trainable(field))
        try:
            jax.eval_shape(lambda each: optimiser.update(each, optimiser.init(each), each), moving)
        except TypeError as error:
            text = "optimiser must need nothing but gradients and parameters"
            raise ValueError(f"{text}: {checks.first_line(error)}") from error
    known = isinstance(settings.objective, TrajectoryLoss | RecordLoss)
    if weight is not None and settings.regulariser is None and known:
        remedy = "leave it out, or use one of hybrid_jax.training.loss.REGULARISERS"
        given = checks.short_repr(weight)
        raise ValueError(f"regulariser_weight is {given} but settings.regulariser is None; {remedy}")
    shared = validated_on, settings, ADAM if optimiser is None else _negated(optimiser)
    return data, shared, WEIGHT if weight is None else weight


def _check_field(field: Learner, data: dict[str, Any], settings: Settings) -> None:
    """Reject a field that learns nothing, and windows that do not match it; other learners check their own windows."""
    if isinstance(settings.objective, TrajectoryLoss):
        check_callable(field)
    if isinstance(settings.objective, RecordLoss):
        checks.instance("field", field, StateSpaceModel)
    if not any(jax.tree.leaves(trainable(field))):
        missing = "no array of floating-point numbers; convert Python floats by jnp.asarray"
        raise ValueError(f"field: {type(field).__name__} has nothing to learn, {missing}")
    for path, leaf in jax.tree_util.tree_leaves_with_path(field):
        if isinstance(leaf, jax.Array) and leaf.shape == () and jnp.issubdtype(leaf.dtype, jnp.integer):
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise ValueError(f"field: {name} is an integer, which is not learned; make it a float, or a Python int")
    field = dynamics_of(field)
    for name, windows in ((name, states_of(each)) for name, each in data.items()):
        if isinstance(field, AbstractVectorField):
            try:
                checked(field, windows.x0, windows.u, windows.dt, settings.solver, windows=True)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
            check_like(windows, states_of(data["train"]), name)
            check_batch_norm(field, *(np.asarray(part).T for part in (windows.x0[:2], windows.u[:2, 0])))


def ready(field: Learner, train: Any) -> Learner:
    """Set the scaling and motion of a field; warn if you will need `like` to load it from a file."""
    if isinstance(field, StateSpaceModel) and isinstance(train, RecordWindows):
        return replace(field, field=with_motion(with_scaling(field.field, train.states), train.states))
    if (reason := check_savable(field)) is not None:
        checks.warn(reason)
    return with_motion(with_scaling(field, train), train) if isinstance(field, AbstractVectorField) else field


def compared(result: FitResult, data: PyTree, settings: Settings) -> FitResult:
    """Add the `discretisation` to a result, and warn if it is too large."""
    loss = settings.objective
    if result.status == Status.DIVERGED or not (isinstance(loss, TrajectoryLoss) and isinstance(data, Trajectories)):
        return result
    moved = compare_steps(result.best, data, settings.solver, loss.divisor())
    return replace(result, discretisation=moved)


def drive(state: FitState, plan: RunConfig, data: PyTree, shared: Shared, progress: Report | bool | None) -> FitResult:
    """Run to the end in blocks of epochs, with progress reports between them."""
    validated_on, settings, optimiser = shared
    # Weakly typed numbers would return as typed ones, and the second block would compile again.
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.asarray(leaf).dtype) if eqx.is_array(leaf) else leaf, state)
    losses, most, empty, interrupt = [np.zeros((0, 2))], 1, jnp.zeros((BLOCK, 2)), None
    if settings.objective == TrajectoryLoss() and any(map(overflows, (data, validated_on))):
        state = replace(state, status=jnp.full_like(state.status, Status.DIVERGED))  # without compiling
    # The default is not an argument: programs with an optimiser's closures are not cached.
    chosen = {} if optimiser is fitting.ADAM else {"optimiser": optimiser}
    train = _train_by_kernels if compiler_options(state.field, data, settings) else _train
    with _reporting(progress, int(plan.max_epochs)) as report, solver_errors(settings.solver):
        try:
            while int(state.status) == Status.RUNNING:
                began, first = time.perf_counter(), int(state.epoch)
                until = jnp.asarray(first + most, jnp.int32)  # an array, so that one program serves all blocks
                after, rows = train(state, plan, data, validated_on, settings, until, losses=empty, **chosen)
                state, losses = after, [*losses, np.asarray(rows)[: int(after.epoch) - first]]
                report(int(state.epoch), state)
                most = int(np.clip(most * BLOCK_SECONDS / (time.perf_counter() - began), 1, min(BLOCK, 4 * most)))
        except KeyboardInterrupt as error:
            interrupt = error
    history, status = History(*np.concatenate(losses).T), Status(int(state.status))
    best_epoch, epochs = int(state.best_epoch), int(state.epoch)
    result = FitResult(state.best, state.best_mse, best_epoch, state.field, epochs, status, history, state)
    if interrupt is not None:
        raise FitInterrupted(result) from interrupt
    return result


_train, _train_by_kernels = jit_by_size()(fitting.run), jit_by_size(FAST_COMPILE)(fitting.run)


@cache  # the same object for the same optimiser, so that its program is compiled once
def _negated(optimiser: Optimiser) -> Optimiser:
    """Negate the updates of an optimiser, since `fitting` subtracts them."""
    return optax.chain(optimiser, optax.scale(-1.0))


@contextmanager
def _reporting(progress: Report | bool | None, most: int) -> Iterator[Report]:
    if not progress:
        yield lambda epoch, state: None
    elif callable(progress):
        yield progress
    else:
        try:
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn
        except ImportError as error:
            hint = "pip install 'hybrid_jax[experiments]', or pass a function of (epoch, state)"
            raise ImportError(f"progress: the bar needs rich: {hint}") from error

        columns = "epoch", MofNCompleteColumn(), BarColumn(), "{task.description}"
        clocks = TimeElapsedColumn(), "at most", TimeRemainingColumn()
        with Progress(*columns, *clocks, console=Console(stderr=True)) as bar:
            task = bar.add_task("compiling", total=most)
            best = "best validation loss {:.3g}"
            yield lambda epoch, state: bar.update(task, completed=epoch, description=best.format(float(state.best_mse)))
