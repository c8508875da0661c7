"""One training run as a pure function: minibatches, the optimiser, validation, the best epoch, early stopping."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from hybrid_jax import checks
from hybrid_jax.dynamics.base import trainable
from hybrid_jax.status import Status
from hybrid_jax.training.objective import Learner, Settings

Optimiser = optax.GradientTransformation
ADAM = optax.scale_by_adam()
SHORTCUT = 8  # a run that uses at most 1 / SHORTCUT of its listed windows sorts only that part


class RunConfig(eqx.Module):
    """Hyper-parameters that may differ between the runs of a sweep, unlike `Settings`; see `fit`."""

    rates: PyTree  # a tree prefix of the field: one number, or e.g. `Hybrid(1e-2, 1e-4)`
    subset: Int[Array, " n"]  # indices of the training windows that the run may use
    n_train: Int[Array, ""]  # number of windows that it uses, the first of the subset
    min_epochs: Int[Array, ""]
    patience: Int[Array, ""]
    max_epochs: Int[Array, ""]
    regulariser_weight: Float[Array, ""]  # λ
    validate_on: Int[Array, " v"] | None = None  # indices of the validation windows to use, by default all


class FitState(eqx.Module):
    """The complete state of a run between two epochs."""

    field: Learner
    adam: PyTree
    best: Learner  # the field with the best validation loss so far, and the initial field before the first epoch
    best_mse: Float[Array, ""]
    best_epoch: Int[Array, ""]
    epoch: Int[Array, ""]
    status: Int[Array, ""]
    train_loss: Float[Array, ""]
    key: PRNGKeyArray


def start(field: Learner, key: PRNGKeyArray, optimiser: Optimiser = ADAM) -> FitState:
    """Return a run at epoch 0. The key determines the order of the minibatches."""
    zero, infinity = jnp.zeros((), jnp.int32), jnp.array(jnp.inf)
    adam = optimiser.init(eqx.filter(field, trainable(field)))
    key = jax.random.key_data(key)  # an ordinary array: it can be stacked, moved to the host and saved
    return FitState(field, adam, field, infinity, zero, zero, zero + Status.RUNNING, infinity, key)


def run(
    state: FitState,
    plan: RunConfig,
    train: PyTree,
    validation: PyTree,
    settings: Settings,
    until: Int[Array, ""] | int,
    optimiser: Optimiser = ADAM,
    losses: Float[Array, "e 2"] | None = None,
) -> tuple[FitState, Float[Array, "e 2"] | None]:
    """Continue until the run has stopped or has completed `until` epochs; `losses` is filled from its start."""
    first = state.epoch
    # A loop carries only arrays, but a field may have other leaves, for example an activation function.
    arrays, rest = eqx.partition(state, eqx.is_array)

    def is_running(carry) -> Bool[Array, ""]:
        state = eqx.combine(carry[0], rest)
        return (state.status == Status.RUNNING) & (state.epoch < until)

    def one_epoch(carry):
        state, losses = eqx.combine(carry[0], rest), carry[1]
        after, error = _epoch(state, plan, train, validation, settings, optimiser)
        if losses is not None:
            row = jnp.stack([after.train_loss, error]).astype(losses.dtype)
            losses = losses.at[state.epoch - first].set(row, mode="drop")
        return eqx.filter(after, eqx.is_array), losses

    arrays, losses = jax.lax.while_loop(is_running, one_epoch, (arrays, losses))
    return eqx.combine(arrays, rest), losses


def _epoch(
    state: FitState, plan: RunConfig, train: PyTree, validation: PyTree, settings: Settings, optimiser: Optimiser
) -> tuple[FitState, Float[Array, ""]]:
    """Train once on the shuffled windows, then validate; also return the validation loss."""
    key, order_key = jax.random.split(state.key)
    order, size = _shuffled(plan, order_key), settings.batch_size
    batches = plan.n_train // size
    arrays, rest = eqx.partition(state.field, eqx.is_array)  # as in `run`

    def update(i, carry):
        arrays, adam, total = carry
        picked = train[jax.lax.dynamic_slice(order, (i * size,), (size,))]
        field, adam, value = gradient_step(eqx.combine(arrays, rest), adam, plan, picked, settings, optimiser)
        return eqx.filter(field, eqx.is_array), adam, total + value

    arrays, adam, total = jax.lax.fori_loop(0, batches, update, (arrays, state.adam, jnp.zeros(())))
    field = eqx.combine(arrays, rest)
    own = validation if plan.validate_on is None else validation[plan.validate_on]
    error = settings.objective.validate(field, own, settings)
    return _updated(state, plan, field, adam, key, total / batches, error), error


def gradient_step(
    field: Learner, adam: PyTree, plan: RunConfig, picked: PyTree, settings: Settings, optimiser: Optimiser = ADAM
) -> tuple[Learner, PyTree, Float[Array, ""]]:
    """Take one optimiser step on a minibatch, and update the running statistics."""
    parameters, rest = eqx.partition(field, trainable(field))
    # Gathered once: without the barrier the gather is fused into, and repeated by, everything that reads the minibatch.
    batch = jax.lax.optimization_barrier(settings.objective.batch(picked, settings))

    def objective(parameters):
        candidate = eqx.combine(parameters, rest)
        return settings.objective.loss(candidate, batch, settings, plan.regulariser_weight)

    (value, seen), gradient = jax.value_and_grad(objective, has_aux=True)(parameters)
    direction, adam = optimiser.update(gradient, adam, parameters)

    def descend(rate, parameters, direction):
        return jax.tree.map(lambda p, d: (p - rate * d).astype(p.dtype), parameters, direction)

    moved = jax.tree.map(descend, plan.rates, parameters, direction)
    return settings.objective.observe(eqx.combine(moved, rest), batch, seen), adam, value


def make_run_config(rates, subset, n_train, min_epochs, patience, max_epochs, regulariser_weight) -> RunConfig:
    """Return a configuration with arrays instead of numbers, as `vmap` needs; ValueError if one is out of range."""
    for rate in jax.tree.leaves(rates):
        checks.not_negative("rates", rate)
    counts = {"n_train": n_train, "min_epochs": min_epochs, "patience": patience, "max_epochs": max_epochs}
    for name, value in counts.items():
        checks.count(name, value, least=int(name == "max_epochs"))
    checks.not_negative("regulariser_weight", regulariser_weight)
    integers = {name: jnp.asarray(value, jnp.int32) for name, value in (counts | {"subset": subset}).items()}
    weight = jnp.asarray(regulariser_weight, float)
    return RunConfig(rates=jax.tree.map(jnp.asarray, rates), regulariser_weight=weight, **integers)


def _shuffled(plan: RunConfig, key: PRNGKeyArray) -> Int[Array, " n"]:
    """Return the first n_train windows of the subset in random order, then the rest."""
    listed, few = plan.subset.shape[0], plan.subset.shape[0] // SHORTCUT

    def among(first: int) -> Int[Array, " n"]:
        # The first numbers are the same however many are drawn (jax_threefry_partitionable).
        draws = jax.random.uniform(key, (first,))
        order = jnp.argsort(jnp.where(jnp.arange(first) < plan.n_train, draws, jnp.inf))
        return plan.subset.at[:first].set(plan.subset[:first][order])

    return jax.lax.cond(plan.n_train <= few, lambda: among(few), lambda: among(listed))


def _updated(state, plan, field, adam, key, train_loss, error) -> FitState:
    finished = state.epoch + 1
    finite = jnp.isfinite(train_loss) & jnp.isfinite(error)
    better = finite & (error < state.best_mse)
    best = jax.tree.map(lambda new, old: jnp.where(better, new, old) if eqx.is_array(new) else new, field, state.best)
    best_epoch = jnp.where(better, finished, state.best_epoch)
    patient = (finished < plan.min_epochs) | (finished - best_epoch < plan.patience)
    stopped = jnp.where(best_epoch > 1, Status.OK, Status.STALLED)
    status = jnp.where(patient, jnp.where(finished >= plan.max_epochs, Status.CAPPED, Status.RUNNING), stopped)
    # Python integers become 64 bit in double precision, but the loop carries 32 bit.
    status = jnp.where(finite, status, Status.DIVERGED).astype(jnp.int32)
    best_mse = jnp.where(better, error, state.best_mse)
    return FitState(field, adam, best, best_mse, best_epoch, finished, status, train_loss, key)
