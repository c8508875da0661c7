"""Training in stages: physics first and then the residual, short windows first and then longer ones, group by group.

A stage is one run of `training`, from the best field of the stage before, with rates and a horizon of its own. What a
stage does not improve on the windows of its validation it leaves as it was.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray, PyTree

from hybrid_jax import checks
from hybrid_jax.dynamics.base import trainable
from hybrid_jax.io.archive import named_leaves
from hybrid_jax.training.fitting import FitState, RunConfig, make_run_config, run, start
from hybrid_jax.training.objective import Learner, Settings
from hybrid_jax.training.preparation import prepared
from hybrid_jax.trajectories import Trajectories


@dataclass(frozen=True)
class Stage:
    """One run.

    Attributes:
        rates: learning rate of each group, by the beginning of its path in the field, such as "physics",
            "residual/weight_out" or "physics/deviations/drag"; the longest that fits counts, and what no group holds
            stays as it is. "" is the whole field.
        steps: intervals of a window that are trained on, from its start; all, if none are named.
        epochs: the most of them.
        patience: epochs without a better validation after which the stage ends.

    Raises:
        ValueError: a rate, or a count, that makes no sense.
    """

    rates: Mapping[str, float]
    steps: int | None = None
    epochs: int = 100
    patience: int = 20

    def __post_init__(self):
        for rate in self.rates.values():
            checks.not_negative("rates", rate)
        for name in ("epochs", "patience"):
            checks.count(name, getattr(self, name))
        if self.steps is not None:
            checks.count("steps", self.steps)


def rates_by_group(field: Learner, groups: Mapping[str, float]) -> PyTree:
    """A tree like the learned part of a field, with the rate of its group for each array; see `Stage`.

    Raises:
        ValueError: a group that holds no learned array, and which paths there are.
    """
    learned = eqx.filter(field, trainable(field))
    paths = list(named_leaves(learned))
    for group in groups:
        if not any(_is_in(path, group) for path in paths):
            raise ValueError(f"rates: no learned array begins with {group!r}, only {', '.join(paths)}")

    def rate(path, leaf):
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        found = [group for group in groups if _is_in(name, group)]
        return jnp.asarray(groups[max(found, key=len)] if found else 0.0, float)

    return jax.tree_util.tree_map_with_path(rate, learned)


def cut(windows: Trajectories, steps: int | None) -> Trajectories:
    """The first `steps` intervals of each window.

    Raises:
        ValueError: the windows are shorter.
    """
    if steps is None:
        return windows
    checks.count("steps", steps)
    if steps > windows.horizon:
        raise ValueError(f"steps must be at most the {windows.horizon} intervals of the windows, got {steps}")
    return Trajectories(windows.x0, windows.u[..., :steps, :], windows.x[..., :steps, :], windows.dt)


def judged(state: FitState, validation: PyTree, settings: Settings) -> FitState:
    """A run at its start that is to beat its own start: `best` stays the start until an epoch is better.

    Args:
        validation: as the objective has prepared it.
    """
    error = settings.objective.validate(state.field, validation, settings)
    return replace(state, best_mse=jnp.asarray(error, state.best_mse.dtype))


def fit_in_stages(
    field: Learner,
    train: Trajectories,
    validation: Trajectories,
    key: PRNGKeyArray,
    stages: Sequence[Stage],
    settings: Settings | None = None,
    regulariser_weight: float = 0.0,
) -> list[FitState]:
    """The runs of all stages, one after the other; the last one's `best` is the trained field.

    Every stage is judged on whole validation windows, and only what is better there than the field that it began with
    is kept, from the first stage on.

    Raises:
        ValueError: what `preparation.prepared` refuses; shorter windows than a stage asks
            for; rates of a group that the field has not; or no stages.
    """
    settings = Settings() if settings is None else settings
    data, judged_on = prepared(field, train, validation, key, settings)
    if not stages:
        raise ValueError("stages must be some Stage, got none")
    states = []
    for stage, stage_key in zip(stages, jax.random.split(key, len(stages)), strict=True):
        plan = make_run_config(
            rates_by_group(field, stage.rates),
            jnp.arange(len(data)),
            len(data),
            0,
            stage.patience,
            stage.epochs,
            regulariser_weight,
        )
        states.append(_fit(start(field, stage_key), plan, cut(data, stage.steps), judged_on, settings))
        field = states[-1].best
    return states


@eqx.filter_jit
def _fit(state: FitState, plan: RunConfig, train: PyTree, validation: PyTree, settings: Settings) -> FitState:
    return run(judged(state, validation, settings), plan, train, validation, settings, plan.max_epochs)


def _is_in(path: str, group: str) -> bool:
    return group == "" or path == group or path.startswith(group + "/")
