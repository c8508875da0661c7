"""Training in stages, for example physics first and then the residual, or short windows first and then longer ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray, PyTree

from hybrid_jax import checks
from hybrid_jax.dynamics.base import trainable
from hybrid_jax.io.files import named_leaves
from hybrid_jax.runtime import entry
from hybrid_jax.training.driver import FitResult, Report, checked_arguments, compared, drive, ready
from hybrid_jax.training.fitting import FitState, Optimiser, make_run_config, start
from hybrid_jax.training.objective import Learner, Settings
from hybrid_jax.trajectories import Trajectories


@dataclass(frozen=True)
class Stage:
    """One training run, with the learning rate of each group of parameters.

    The name of a group is the beginning of its path in the field, for example "physics", "residual/weight_out" or
    "physics/deviations/drag"; "" is the whole field. The longest matching name counts. Other parameters are frozen.

    Attributes:
        rates: the learning rate of each group, by its name.
        steps: number of intervals at the start of each window to train on; by default all.
        epochs: the stage stops after this many epochs.
        patience: it also stops after this many epochs without a better validation loss.

    Raises:
        ValueError: if a rate is negative or not finite, or a count is below 1.
    """

    rates: Mapping[str, float]
    steps: int | None = None
    epochs: int = 100
    patience: int = 20

    def __post_init__(self):
        for rate in self.rates.values():
            checks.not_negative("rates", rate)
        for name in ("steps", "epochs", "patience"):
            if (value := getattr(self, name)) is not None:
                checks.count(name, value)


def rates_by_group(field: Learner, groups: Mapping[str, float]) -> PyTree:
    """Return the learning rate of each learned array, as a tree like the field; see `Stage`.

    Args:
        field: any field. Learned arrays that are in no group have rate 0.
        groups: the learning rate of each group, by its name.

    Raises:
        ValueError: if a group has no learned array; the message lists the paths that exist.
    """
    learned = eqx.filter(field, trainable(field))
    paths = list(named_leaves(learned))
    groups_of = [[group for group in groups if not group or f"{path}/".startswith(f"{group}/")] for path in paths]
    for group in groups:
        if not any(group in found for found in groups_of):
            raise ValueError(f"rates: no learned array begins with {group!r}; the paths are {', '.join(paths)}")
    rates = [groups[max(found, key=len)] if found else 0.0 for found in groups_of]
    return jax.tree.structure(learned).unflatten(jnp.asarray(rate, float) for rate in rates)


def cut(windows: Trajectories, steps: int | None) -> Trajectories:
    """Return the first `steps` intervals of each window, or all; ValueError if there are fewer."""
    if steps is None:
        return windows
    if not isinstance(windows, Trajectories):
        raise ValueError(f"steps must be None for windows of records, got {steps}")
    if steps > windows.horizon:
        raise ValueError(f"steps must be at most the {windows.horizon} intervals of the windows, got {steps}")
    return Trajectories(windows.x0, windows.u[..., :steps, :], windows.x[..., :steps, :], windows.dt)


@eqx.filter_jit
def _judged(state: FitState, validation: PyTree, settings: Settings) -> FitState:
    """Return the initial run with the validation loss of its field, which is `best` until an epoch is better."""
    error = settings.objective.validate(state.field, validation, settings)
    return replace(state, best_mse=jnp.asarray(error, state.best_mse.dtype))


@entry
def fit_in_stages(
    field: Learner,
    train: Trajectories,
    validation: Trajectories,
    key: PRNGKeyArray,
    stages: Sequence[Stage],
    *,
    optimiser: Optimiser | None = None,
    regulariser_weight: float | None = None,
    settings: Settings | None = None,
    progress: Report | bool | None = None,
) -> list[FitResult]:
    """Train a field in stages, each from the best field of the previous one. `results[-1].best` is the trained field.

    Each stage is validated on whole windows, and kept only if it improved the field.

    Args:
        field: the initial field.
        train: the training windows; a stage may use only the beginning of each.
        validation: windows that determine the best epoch and the early stopping of each stage.
        key: random key for shuffling minibatches.
        stages: the stages, in order.
        optimiser: any Optax optimiser instead of Adam. The rates of a stage then multiply its updates.
        regulariser_weight: λ, by default 1e-3.
        settings: settings of all stages, with defaults as in `fit`.
        progress: see `fit`.

    Raises:
        ValueError: as in `fit`, or if there are no stages, windows are too short for a stage, or a group is unknown.
    """
    data, shared, weight = checked_arguments(field, train, validation, key, settings, optimiser, regulariser_weight)
    stages = checks.list_of("stages", stages, Stage)
    field, results = ready(field, train), []
    steps = [(rates_by_group(field, stage.rates), cut(data, stage.steps), stage) for stage in stages]
    for (rates, windows, stage), stage_key in zip(steps, jax.random.split(key, len(stages)), strict=True):
        plan = make_run_config(rates, jnp.arange(len(data)), len(data), 0, stage.patience, stage.epochs, weight)
        state = _judged(start(field, stage_key, shared[-1]), *shared[:2])
        results.append(drive(state, plan, windows, shared, progress))
        field = results[-1].best
    results[-1] = compared(results[-1], data, shared[1])
    return results
