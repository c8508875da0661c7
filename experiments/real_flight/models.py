"""The models of a real vehicle before training, and all lanes of one taken through the stages of a recipe."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from experiments.real_flight.config import LEARN
from experiments.real_flight.folds import Lessons, padded
from experiments.real_flight.logs import Windows
from experiments.real_flight.recipes import Recipe, Step, stage_of
from experiments.runner.stages import Stages
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid, trainable
from hybrid_jax.dynamics.baselines import FrozenRates
from hybrid_jax.dynamics.kinematics import Kinematics
from hybrid_jax.dynamics.multirotor import Multirotor, multirotor, with_vehicle
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.io.archive import named_leaves
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.networks.mlp import InputScaling, zero_output
from hybrid_jax.networks.views import restricted
from hybrid_jax.sweep.lanes import lane, stack
from hybrid_jax.training import fitting
from hybrid_jax.training.channels import ChannelLoss, channels_from
from hybrid_jax.training.fitting import FitState, RunConfig, make_run_config
from hybrid_jax.training.objective import Settings
from hybrid_jax.training.stages import cut, judged, rates_by_group
from hybrid_jax.trajectories import Trajectories, concatenate
from hybrid_jax.vehicle import Vehicle

NETWORK, ORDER = range(2)  # what the keys of a seed are for


@dataclass(frozen=True)
class Craft:
    """What is known of the vehicle, and what is learned of it.

    Attributes:
        vehicle: its constants.
        terms: nominal values of what a rigid body leaves out.
        learn: names of `multirotor.SHAPES`.
    """

    vehicle: Vehicle
    terms: Terms
    learn: tuple[str, ...] = LEARN

    def physics(self, recipe: Recipe) -> AbstractVectorField:
        """f_p of a recipe at its nominal values."""
        terms = replace(self.terms, torque_gain=(0.0, 0.0, 0.0)) if recipe.physics == "torque_off" else self.terms
        body = multirotor(self.vehicle, recipe.learn or self.learn, terms)
        return FrozenRates(body) if recipe.physics == "frozen_rates" else body

    def thrust(self) -> AbstractVectorField:
        """Nominal thrust with frozen rates: the baseline that errors are measured by."""
        return FrozenRates(multirotor(self.vehicle, (), self.terms))


def fresh(model: str, craft: Craft, recipe: Recipe, hidden: int, seeds: int) -> AbstractVectorField:
    """The untrained models of all seeds, stacked; a hybrid begins as its physics."""
    hover = InputScaling(craft.vehicle.hover_speed, craft.vehicle.hover_speed / 10)
    physics = craft.physics(recipe)

    # Without physics there is no other term that could make an estimator's position and velocity agree.
    outputs = "motion" if model == "no_physics" else recipe.outputs

    def network(key: PRNGKeyArray) -> AbstractVectorField:
        seen: dict[str, Any] = {"inputs": "body_motion", "outputs": outputs, "norm": "none", "scaling": hover}
        return zero_output(restricted(key, hidden=hidden, **seen))

    def build(seed):
        match model:
            case "hybrid":
                return Hybrid(physics, network(_key(seed, NETWORK)))
            case "no_physics":
                return Hybrid(Kinematics(), network(_key(seed, NETWORK)))
            case _:
                return physics

    return jax.device_get(eqx.filter_jit(eqx.filter_vmap(build))(np.arange(seeds)))


def moved(field: Any, vehicle: Vehicle) -> Any:
    """Stacked models on another vehicle, such as the same one with a payload, their θ_p in SI units as it was."""

    def is_body(node) -> bool:
        return isinstance(node, Multirotor)

    def move(node):
        return with_vehicle(node, vehicle) if is_body(node) else node

    def one(field):
        return jax.tree.map(move, field, is_leaf=is_body)

    return jax.device_get(eqx.filter_jit(eqx.filter_vmap(one))(field))


def settings_of(craft: Craft, lessons: Lessons, recipe: Recipe, batch_size: int) -> Settings:
    """Each channel weighed by the error of nominal thrust with frozen rates at the end of the training windows."""
    position, *others = channels_from(craft.thrust(), lessons.train.windows)  # in the state's order
    position = replace(position, scale=recipe.position * position.scale)
    return Settings(batch_size, objective=ChannelLoss((position, *others), recipe.huber))


@dataclass(frozen=True)
class Lane:
    """What one lane is asked to do.

    Attributes:
        seed: of the order of its minibatches.
        subset: the windows that it learns from.
        share: of the epochs of the recipe.
    """

    seed: int
    subset: np.ndarray
    share: float


@dataclass(frozen=True)
class Trained:
    """Lanes at the end of their stages.

    Attributes:
        fields: the trained models, stacked.
        val_loss: of each on its validation windows.
        epochs: of each, over all stages.
        best_epochs: of each stage, of each lane.
        status: of the last stage.
    """

    fields: Any
    val_loss: np.ndarray
    epochs: np.ndarray
    best_epochs: list[np.ndarray]
    status: np.ndarray


def in_stages(
    name: str,
    model: str,
    fields: Any,
    lanes: Sequence[Lane],
    steps: Sequence[Step],
    lessons: Lessons,
    pool: int,
    settings: Settings,
    stages: Stages,
) -> Trained:
    """Take all lanes through the steps, each from the best that it was: what no epoch betters stays as it was.

    Args:
        pool: to how many windows the training windows are padded.
    """
    train, finals = padded(lessons.train.windows, pool), []
    for number, step in enumerate(steps, 1):
        plans = _plans(model, fields, lanes, step)
        data = Dataset({"train": cut(train, step.steps), "validation": lessons.validation}, {})
        starts = _starts(fields, [each.seed for each in lanes], number, lessons.validation, settings)
        finals.append(stages.run(f"{name} {number}", starts, plans, settings, data))
        fields = finals[-1].best
    return _trained(fields, finals)


def refitted(
    name: str,
    model: str,
    fields: Any,
    lanes: Sequence[Lane],
    steps: Sequence[Step],
    lessons: Lessons,
    first: Trained,
    settings: Settings,
    stages: Stages,
) -> Trained:
    """The same on all windows there are, each stage for as many epochs as were best in the first training.

    Its validation windows are among those learned from, so nothing is chosen by them: each stage's last field counts.
    """
    finals = []
    for number, (step, best) in enumerate(zip(steps, first.best_epochs, strict=True), 1):
        plans = _plans(model, fields, lanes, step)
        data = Dataset({"train": cut(lessons.train.windows, step.steps), "validation": lessons.validation}, {})
        starts = _starts(fields, [each.seed for each in lanes], number, lessons.validation, settings)
        exact = _until(plans, best)
        final = stages.run(f"{name} again {number}", starts, exact, settings, data)
        fields = _where(best > 0, final.field, fields)
        finals.append(final)
    return replace(first, fields=fields, epochs=first.epochs + np.sum([final.epoch for final in finals], axis=0))


def all_windows(lessons: Lessons, more: Windows) -> Lessons:
    """The lessons with further windows to learn from."""
    old = lessons.train
    both = concatenate([old.windows, more.windows])
    return replace(lessons, train=Windows(both, [*old.sizes, *more.sizes], old.stride))


def _plans(model: str, fields: Any, lanes: Sequence[Lane], step: Step) -> RunConfig:
    longest = max(len(each.subset) for each in lanes)
    one = lane(fields, 0)

    def plan(each: Lane) -> RunConfig:
        stage = stage_of(step, model, each.share)
        subset = np.resize(each.subset, longest)  # of one length; only the first len(subset) are used
        rates = rates_by_group(one, rates_of(step, model, one))
        return make_run_config(rates, subset, len(each.subset), 0, stage.patience, stage.epochs, 0.0)

    return jax.device_get(stack([jax.device_get(plan(each)) for each in lanes]))


def rates_of(step: Step, model: str, field: AbstractVectorField) -> dict[str, float]:
    """The learning rate of each group of a field's arrays: none for what the step keeps."""
    return {**stage_of(step, model).rates, **dict.fromkeys(_paths_of(step.kept, field), 0.0)}


def _paths_of(names: Sequence[str], field: AbstractVectorField) -> list[str]:
    """Where in a field there are learned parameters of these names."""
    learned = eqx.filter(field, trainable(field))
    return [path for path in named_leaves(learned) if path.rpartition("/")[-1] in names]


def _until(plans: RunConfig, epochs: np.ndarray) -> RunConfig:
    """Plans that end after so many epochs, and not before; no fewer than one."""
    exact = np.maximum(epochs, 1).astype(np.int32)
    return eqx.tree_at(lambda plan: (plan.max_epochs, plan.min_epochs), plans, (exact, exact))


def _starts(fields: Any, seeds: Sequence[int], number: int, validation: Trajectories, settings: Settings) -> FitState:
    def begin(field, seed):
        return fitting.start(field, jax.random.fold_in(_key(seed, ORDER), number))

    starts = jax.device_get(eqx.filter_jit(eqx.filter_vmap(begin))(fields, np.asarray(seeds)))
    errors = jax.device_get(_errors_at_start(starts, validation, settings))
    return eqx.tree_at(lambda state: state.best_mse, starts, errors)


@eqx.filter_jit
def _errors_at_start(states: FitState, validation: Trajectories, settings: Settings) -> Float[Array, " lanes"]:
    return jax.lax.map(lambda state: judged(state, validation, settings).best_mse, states)


def _trained(fields: Any, finals: Sequence[FitState]) -> Trained:
    last = finals[-1]
    return Trained(
        fields=fields,
        val_loss=np.asarray(last.best_mse),
        epochs=np.sum([final.epoch for final in finals], axis=0),
        best_epochs=[np.asarray(final.best_epoch) for final in finals],
        status=np.asarray(last.status),
    )


def _where(mask: np.ndarray, new: Any, old: Any) -> Any:
    def pick(new, old):
        return np.where(mask.reshape(-1, *(1,) * (np.ndim(new) - 1)), new, old) if eqx.is_array(new) else new

    return jax.tree.map(pick, new, old)


def _key(seed, purpose: int) -> PRNGKeyArray:
    return jax.random.fold_in(jax.random.key(seed), purpose)
