"""Training in stages, for example physics first and then the residual, or short windows first and then longer ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray, PyTree

from hybrid_jax import checks
from hybrid_jax.dynamics.base import trainable
from hybrid_jax.io.archive import named_leaves
from hybrid_jax.runtime import entry
from hybrid_jax.training.driver import FitResult, Report, checked_arguments, drive, ready
from hybrid_jax.training.fitting import FitState, Optimiser, make_run_config, start
from hybrid_jax.training.objective import Learner, Settings
from hybrid_jax.trajectories import Trajectories


@dataclass(frozen=True)
class Stage:
    """One training run, with the learning rate of each group of parameters.

    A group is named by the beginning of its path in the field, e.g. "physics", "residual/weight_out" or
    "physics/deviations/drag"; "" is the whole field. The longest name that matches counts. Other parameters are frozen.

    Attributes:
        rates: learning rate by the name of a group.
        steps: initial intervals of each window to train on; by default all.
        epochs: stop after this many.
        patience: or after this many without a better validation loss.

    Raises:
        ValueError: a rate that is negative or not finite, or a count below 1.
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
    """The learning rate of each learned array of a field, as a tree like the field; see `Stage`.

    Args:
        field: its learned arrays get a rate each; 0 if they are in no group.
        groups: learning rate by the name of a group.

    Raises:
        ValueError: a group without a learned array; lists the paths that exist.
    """
    learned = eqx.filter(field, trainable(field))
    paths = list(named_leaves(learned))
    groups_of = [[group for group in groups if not group or f"{path}/".startswith(f"{group}/")] for path in paths]
    for group in groups:
        if not any(group in found for found in groups_of):
            raise ValueError(f"rates: no learned array begins with {group!r}, only {', '.join(paths)}")
    rates = [groups[max(found, key=len)] if found else 0.0 for found in groups_of]
    return jax.tree.structure(learned).unflatten(jnp.asarray(rate, float) for rate in rates)


def cut(windows: Trajectories, steps: int | None) -> Trajectories:
    """The first `steps` intervals of each window, or all; ValueError if there are fewer."""
    if steps is None:
        return windows
    checks.count("steps", steps)
    if steps > windows.horizon:
        raise ValueError(f"steps must be at most the {windows.horizon} intervals of the windows, got {steps}")
    return Trajectories(windows.x0, windows.u[..., :steps, :], windows.x[..., :steps, :], windows.dt)


def judged(state: FitState, validation: PyTree, settings: Settings) -> FitState:
    """The initial run with the validation loss of its field, which is `best` until an epoch is better."""
    error = settings.objective.validate(state.field, validation, settings)
    return replace(state, best_mse=jnp.asarray(error, state.best_mse.dtype))


_judged = eqx.filter_jit(judged)


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
    """Train a field in stages, each from the best field of the one before; `results[-1].best` is the trained field.

    Every stage is validated on whole windows and kept only if its field is better there than its initial one.

    Args:
        field: the initial field.
        train: training windows, of which each stage may use a shorter beginning.
        validation: windows that determine the best epoch and early stopping of each stage.
        key: random key for shuffling minibatches.
        stages: one training run each, in this order.
        optimiser: any Optax optimiser instead of Adam, whose updates the rates of a stage then multiply.
        regulariser_weight: λ, by default 1e-3.
        settings: of all stages; defaults as in `fit`.
        progress: True for a bar on stderr, or a function of (epoch, state) that is called about twice a second.

    Raises:
        ValueError: see `fit`; no stages; windows shorter than a stage needs; or rates of an unknown group.
    """
    data, shared, weight = checked_arguments(field, train, validation, key, settings, optimiser, regulariser_weight)
    if not (stages := checks.list_of("stages", stages, Stage)):
        raise ValueError("stages must contain at least one Stage")
    field, results = ready(field, train), []
    steps = [(rates_by_group(field, stage.rates), cut(data, stage.steps), stage) for stage in stages]
    for (rates, windows, stage), stage_key in zip(steps, jax.random.split(key, len(stages)), strict=True):
        plan = make_run_config(rates, jnp.arange(len(data)), len(data), 0, stage.patience, stage.epochs, weight)
        state = _judged(start(field, stage_key, shared[-1]), *shared[:2])
        results.append(drive(state, plan, windows, shared, progress))
        field = results[-1].best
    return results
