"""One training run as a pure function: minibatches, Adam, validation, the best epoch, early stopping.

What is swept over (rates, data size, patience, …) is an argument, `Plan`; what shapes the program is `Settings`
(objective.py).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.training.objective import Learner, Settings, TrajectoryLoss
from hybrid_jax.training.preparation import prepared
from hybrid_jax.trajectories import Trajectories

RUNNING, STOPPED, CAPPED, DIVERGED = range(4)
WEIGHT = 1e-3  # λ, where none is given
FEW = 8  # one in so many of the listed windows
STATUS_NAMES = {RUNNING: "running", STOPPED: "ok", CAPPED: "capped", DIVERGED: "diverged"}


class RunConfig(eqx.Module):
    """What may differ between the lanes of a sweep.

    Attributes:
        rates: Adam's learning rates, a tree prefix of the field: one number, or e.g. `Hybrid(1e-2, 1e-4)`.
        subset: indices of training windows in the order in which this lane may use them.
        n_train: how many of `subset` it does use; nested by construction.
        min_epochs: no early stop before this many epochs.
        patience: stop after this many epochs without a better validation loss.
        max_epochs: the cap.
        regulariser_weight: λ.
    """

    rates: PyTree
    subset: Int[Array, " n"]
    n_train: Int[Array, ""]
    min_epochs: Int[Array, ""]
    patience: Int[Array, ""]
    max_epochs: Int[Array, ""]
    regulariser_weight: Float[Array, ""]


class FitState(eqx.Module):
    """A run between two epochs; all that is needed to go on.

    `best` is the field of the best validation loss so far: the start itself until an epoch has been completed.
    """

    field: Learner
    adam: PyTree
    best: Learner
    best_mse: Float[Array, ""]
    best_epoch: Int[Array, ""]
    epoch: Int[Array, ""]
    status: Int[Array, ""]
    train_loss: Float[Array, ""]
    key: PRNGKeyArray


def start(field: Learner, key: PRNGKeyArray) -> FitState:
    """A run at epoch 0; the key sets the order of minibatches."""
    zero = jnp.zeros((), jnp.int32)
    infinity = jnp.array(jnp.inf)
    adam = optax.scale_by_adam().init(eqx.filter(field, trainable(field)))
    # Raw key data is an ordinary array: it can be stacked by lane, moved to the host and saved.
    key = jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key
    return FitState(field, adam, field, infinity, zero, zero, zero + RUNNING, infinity, key)


def run(
    state: FitState,
    plan: RunConfig,
    train: PyTree,
    validation: PyTree,
    settings: Settings,
    until: Int[Array, ""] | int,
) -> FitState:
    """Go on until the run has stopped or has completed `until` epochs.

    Args:
        train, validation: as the objective has prepared them.
    """

    def going(state: FitState) -> Bool[Array, ""]:
        return (state.status == RUNNING) & (state.epoch < until)

    # A user's field may hold leaves that are no arrays (an activation function); a loop carries arrays only.
    arrays, rest = eqx.partition(state, eqx.is_array)

    def one_epoch(arrays):
        return eqx.filter(epoch(eqx.combine(arrays, rest), plan, train, validation, settings), eqx.is_array)

    arrays = jax.lax.while_loop(lambda arrays: going(eqx.combine(arrays, rest)), one_epoch, arrays)
    return eqx.combine(arrays, rest)


def epoch(state: FitState, plan: RunConfig, train: PyTree, validation: PyTree, settings: Settings) -> FitState:
    """One pass over the lane's training windows in a new order, then a validation."""
    key, order_key = jax.random.split(state.key)
    order = _shuffled(plan, order_key)
    batches = plan.n_train // settings.batch_size

    arrays, rest = eqx.partition(state.field, eqx.is_array)  # as in `run`

    def update(i, carry):
        arrays, adam, total = carry
        picked = jax.lax.dynamic_slice(order, (i * settings.batch_size,), (settings.batch_size,))
        field, adam, value = gradient_step(eqx.combine(arrays, rest), adam, plan, train[picked], settings)
        return eqx.filter(field, eqx.is_array), adam, total + value

    arrays, adam, total = jax.lax.fori_loop(0, batches, update, (arrays, state.adam, jnp.zeros(())))
    field = eqx.combine(arrays, rest)
    error = settings.objective.validate(field, validation, settings)
    return _judge(state, plan, field, adam, key, total / batches, error)


def gradient_step(
    field: Learner, adam: PyTree, plan: RunConfig, picked: PyTree, settings: Settings
) -> tuple[Learner, PyTree, Float[Array, ""]]:
    """One step of Adam on one minibatch, and what the field observes in it."""
    learned = trainable(field)
    parameters, rest = eqx.partition(field, learned)
    # Gathered once: without the barrier the gather is fused into, and repeated by, everything that reads the minibatch.
    batch = jax.lax.optimization_barrier(settings.objective.batch(picked, settings))

    def objective(parameters):
        candidate = eqx.combine(parameters, rest)
        return settings.objective.loss(candidate, batch, settings, plan.regulariser_weight)

    (value, seen), gradient = jax.value_and_grad(objective, has_aux=True)(parameters)
    direction, adam = optax.scale_by_adam().update(gradient, adam)
    moved = _descend(plan.rates, parameters, direction)
    return settings.objective.observe(eqx.combine(moved, rest), batch, seen), adam, value


def fit(
    field: AbstractVectorField,
    train: Trajectories,
    validation: Trajectories,
    key: PRNGKeyArray,
    *,
    rates: PyTree,
    min_epochs: int = 100,
    patience: int = 20,
    max_epochs: int = 2000,
    regulariser_weight: float | None = None,
    settings: Settings | None = None,
) -> FitState:
    """Train one field on all windows of `train`; `result.best` is the field of the best validation epoch.

    Args:
        regulariser_weight: λ, by default 1e-3.
        settings: by default minibatches of 100 and no regulariser; the paper's is
            `Settings(regulariser=hybrid_jax.training.loss.trajectory_correlation)`.

    Raises:
        ValueError: data that the objective refuses, that are not of the field's states and inputs, or are of a rigid
            body and have no unit quaternions; fewer training windows than a minibatch, or one window normalised by
            itself; a field with nothing to learn; rates that do not go with it; a rule that makes no sense; a weight
            without a regulariser; or no random key.
    """
    settings = Settings() if settings is None else settings
    data, judged_on = prepared(field, train, validation, key, settings)
    try:
        jax.tree.map(lambda *_: None, rates, eqx.filter(field, trainable(field)))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"rates must be a number, or a tree of them that begins as the field does, got {checks.short_repr(rates)}"
        ) from error
    weight = _weight(regulariser_weight, settings)
    plan = make_run_config(rates, jnp.arange(len(data)), len(data), min_epochs, patience, max_epochs, weight)
    return _fit(start(field, key), plan, data, judged_on, settings)


def _weight(asked: float | None, settings: Settings) -> float:
    """λ, or what another objective weighs by it."""
    if asked is None:
        return WEIGHT
    if settings.regulariser is None and isinstance(settings.objective, TrajectoryLoss):
        raise ValueError(
            f"regulariser_weight is {checks.short_repr(asked)} but settings.regulariser is None; leave it out, or "
            "take one of hybrid_jax.training.loss.REGULARISERS"
        )
    return asked


def make_run_config(rates, subset, n_train, min_epochs, patience, max_epochs, regulariser_weight) -> RunConfig:
    """A plan with every number as an array, as `vmap` wants it.

    Raises:
        ValueError: a number that makes no sense, by its name.
    """
    for rate in jax.tree.leaves(rates):
        checks.not_negative("rates", rate)
    counts = {
        "n_train": (n_train, 0),
        "min_epochs": (min_epochs, 0),
        "patience": (patience, 0),
        "max_epochs": (max_epochs, 1),
    }
    for name, (value, least) in counts.items():
        checks.count(name, value, least)
    checks.not_negative("regulariser_weight", regulariser_weight)

    def integer(number) -> Int[Array, "..."]:
        return jnp.asarray(number, jnp.int32)

    return RunConfig(
        rates=jax.tree.map(jnp.asarray, rates),
        subset=integer(subset),
        n_train=integer(n_train),
        min_epochs=integer(min_epochs),
        patience=integer(patience),
        max_epochs=integer(max_epochs),
        regulariser_weight=jnp.asarray(regulariser_weight, float),
    )


@eqx.filter_jit
def _fit(state, plan, train, validation, settings):
    return run(state, plan, train, validation, settings, plan.max_epochs)


def _shuffled(plan: RunConfig, key: PRNGKeyArray) -> Int[Array, " n"]:
    """The first n_train of the lane's windows in random order, then the rest."""
    listed = plan.subset.shape[0]

    def among(first: int) -> Int[Array, " n"]:
        # The same tickets however many are drawn: JAX counts them (jax_threefry_partitionable).
        ticket = jax.random.uniform(key, (first,))
        inside = jnp.arange(first) < plan.n_train
        order = jnp.argsort(jnp.where(inside, ticket, jnp.inf))
        return plan.subset.at[:first].set(plan.subset[:first][order])

    # A lane that uses few of many does not pay for sorting all of them.
    few = listed // FEW
    return jax.lax.cond(plan.n_train <= few, lambda: among(few), lambda: among(listed))


def _descend(rates: PyTree, parameters: Learner, direction: PyTree) -> Learner:
    def part(rate, parameters, direction):
        return jax.tree.map(lambda p, d: (p - rate * d).astype(p.dtype), parameters, direction)

    return jax.tree.map(part, rates, parameters, direction)


def _judge(state, plan, field, adam, key, train_loss, error) -> FitState:
    """The state after an epoch: is it the best, and does the run go on?"""
    finished = state.epoch + 1
    finite = jnp.isfinite(train_loss) & jnp.isfinite(error)
    better = finite & (error < state.best_mse)
    best = jax.tree.map(lambda new, old: jnp.where(better, new, old) if eqx.is_array(new) else new, field, state.best)
    best_epoch = jnp.where(better, finished, state.best_epoch)
    patient = (finished < plan.min_epochs) | (finished - best_epoch < plan.patience)
    status = jnp.where(finished >= plan.max_epochs, CAPPED, RUNNING)
    status = jnp.where(patient, status, STOPPED)
    # Python's integers make 64 bits in JAX's double precision, where the loop carries 32.
    status = jnp.where(finite, status, DIVERGED).astype(jnp.int32)
    best_mse = jnp.where(better, error, state.best_mse)
    return FitState(field, adam, best, best_mse, best_epoch, finished, status, train_loss, key)
