"""Train models in stages: on the source's flights, and on N windows of each fold's flights."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.folds import Fold, evenly_spaced, padded, sampled_indices
from experiments.real_flight.logs import LogSet
from experiments.real_flight.models import ORDER, key_of, move_to_vehicle, objective_of, untrained
from experiments.real_flight.recipes import RECIPES, Step, before_a_change, epoch_factor, stage_of
from experiments.runner.stages import Stages
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.dynamics.vehicle_file import VehicleModel
from hybrid_jax.flights.windows import LogWindows, cut_windows
from hybrid_jax.io.archive import named_leaves
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.sweep.lanes import count, lane, stack
from hybrid_jax.training import fitting
from hybrid_jax.training.channels import ChannelLoss
from hybrid_jax.training.fitting import FitState, RunConfig, make_run_config
from hybrid_jax.training.objective import Settings
from hybrid_jax.training.stages import cut, judged, rates_by_group
from hybrid_jax.trajectories import Trajectories, concatenate


@dataclass(frozen=True)
class Experiment:
    """What an experiment is given.

    Attributes:
        before, after: the vehicle of the source, and that of target and test.
        logs: "source" and, if given, "target" and "test".
        dt: interval between samples [s].
        stages: runs sweeps and caches them.
    """

    config: RealFlightConfig
    before: VehicleModel
    after: VehicleModel
    logs: Mapping[str, LogSet]
    dt: float
    stages: Stages


@dataclass(frozen=True)
class TrainingData:
    """Windows to train on and to stop by, and the loss.

    Attributes:
        capacity: number of windows that the training windows are padded to.
    """

    train: LogWindows
    validation: Trajectories
    objective: ChannelLoss
    capacity: int


@dataclass(frozen=True)
class TrainedModel:
    """The runs of one model, one per seed and number of windows.

    Attributes:
        model: "hybrid", "no_physics" or "physics_only".
        mode: "source_only", "zero_shot", "fine_tuned" or "scratch".
        recipe: a name of `RECIPES`.
        fields: the vector fields, stacked.
        seeds: of each run.
        subsets: indices of the training windows of each run.
        val_loss: of each run, at the best epoch of its last stage.
        epochs: of each run, over all stages.
        best_epochs: of each stage and run.
        status: of each run's last stage.
    """

    model: str
    mode: str
    recipe: str
    fields: Any
    seeds: Sequence[int]
    subsets: Sequence[Int[np.ndarray, " n"]]
    val_loss: Float[np.ndarray, " runs"] = field(default_factory=partial(np.zeros, 0))
    epochs: Int[np.ndarray, " runs"] = field(default_factory=partial(np.zeros, 0, int))
    best_epochs: Sequence[Int[np.ndarray, " runs"]] = ()
    status: Int[np.ndarray, " runs"] = field(default_factory=partial(np.zeros, 0, int))

    def run(self, index: int) -> AbstractVectorField:
        """The field of one run."""
        return lane(self.fields, index)

    def __len__(self) -> int:
        return count(self.fields)

    def size(self, run: int) -> int:
        """The number of target windows that a run was trained on."""
        return len(self.subsets[run]) if self.mode in ("fine_tuned", "scratch") else 0


def source_data(experiment: Experiment, fold: Fold, recipe: str) -> TrainingData:
    """Cut windows of a fold before the change; the loss is scaled by them."""
    train, validation = _windows(experiment, fold, recipe, experiment.config.stride)
    return TrainingData(train, validation, objective_of(experiment.before, train.windows, RECIPES[recipe]), len(train))


def target_data(experiment: Experiment, fold: Fold, recipe: str, objective: ChannelLoss, capacity: int) -> TrainingData:
    """Cut windows of a fold after the change, one at every sample, with the loss of the source."""
    return TrainingData(*_windows(experiment, fold, recipe, 1), objective, capacity)


def _windows(experiment: Experiment, fold: Fold, recipe: str, stride: int) -> tuple[LogWindows, Trajectories]:
    steps = RECIPES[recipe].window
    validation = cut_windows(fold.validation, steps).windows
    return cut_windows(fold.train, steps, stride), evenly_spaced(validation, experiment.config.validation)


def train_on_source(
    experiment: Experiment, name: str, model: str, recipe: str, data: TrainingData, seeds: int
) -> TrainedModel:
    """Train a model on all windows before the change, one run per seed."""
    how = RECIPES[recipe]
    fields = untrained(model, experiment.before, how, experiment.config.hidden, seeds)
    start = TrainedModel(model, "source_only", recipe, fields, range(seeds), [np.arange(len(data.train))] * seeds)
    steps = before_a_change(how) if "target" in experiment.logs else how.source
    return in_stages(experiment, name, start, steps, data)


def refit(experiment: Experiment, name: str, fold: Fold, data: TrainingData, first: TrainedModel) -> TrainedModel:
    """Train a source model again, on the validation flights as well.

    Each stage ends after as many epochs as were best in the first training, and its last field counts: the validation
    windows are trained on, so they can select nothing.
    """
    more = cut_windows(fold.validation, RECIPES[first.recipe].window, experiment.config.stride)
    both = concatenate([data.train.windows, more.windows])
    train = LogWindows(both, [*data.train.sizes, *more.sizes], data.train.stride)
    everything = replace(data, train=train, capacity=len(train))
    fields = untrained(first.model, experiment.before, RECIPES[first.recipe], experiment.config.hidden, len(first))
    start = replace(first, fields=fields, subsets=[np.arange(len(train))] * len(first))
    steps = RECIPES[first.recipe].source
    again = in_stages(experiment, f"{name} again", start, steps, everything, first.best_epochs)
    return replace(first, fields=again.fields, epochs=first.epochs + again.epochs)


def transfer(experiment: Experiment, source: TrainedModel) -> TrainedModel:
    """Move a source model to the vehicle after the change, without training."""
    return replace(source, mode="zero_shot", fields=move_to_vehicle(source.fields, experiment.after.vehicle))


def adapt(
    experiment: Experiment, name: str, mode: str, start: TrainedModel, data: TrainingData, sizes: Sequence[int]
) -> TrainedModel:
    """Train a model on N windows after the change, one run for each size and seed, in this order.

    Args:
        mode: "fine_tuned" starts from the fields of `start`, "scratch" from untrained ones.
    """
    config, how = experiment.config, RECIPES[start.recipe]
    fields = start.fields
    if mode == "scratch":
        fields = untrained(start.model, experiment.after, how, config.hidden, len(start))
    seeds = [seed for _ in sizes for seed in start.seeds]
    subsets = [sampled_indices(data.train.sizes, size, config.draw, s) for size in sizes for s in start.seeds]
    begin = TrainedModel(start.model, mode, start.recipe, lane(fields, np.array(seeds)), seeds, subsets)
    steps = how.scratch if mode == "scratch" else how.adaptation
    return in_stages(experiment, f"{name} {mode}", begin, steps, data)


def in_stages(
    experiment: Experiment,
    name: str,
    start: TrainedModel,
    steps: Sequence[Step],
    data: TrainingData,
    best_epochs: Sequence[np.ndarray] | None = None,
) -> TrainedModel:
    """Train all runs through the stages; each stage starts from the previous stage's best validation checkpoint.

    Args:
        best_epochs: of each stage and run; stages then end after these, with their last fields.
    """
    config, fields, finals = experiment.config, start.fields, []
    settings = Settings(config.batch_size, objective=data.objective)
    train = padded(data.train.windows, data.capacity)
    sizes = map(start.size, range(len(start)))
    factors = [config.epochs * (epoch_factor(size) if size else 1.0) for size in sizes]
    for number, step in enumerate(steps, 1):
        runs = _run_configs(start, fields, step, factors)
        splits = Dataset({"train": cut(train, step.steps), "validation": data.validation}, {})
        states = _start_states(fields, start.seeds, number, data.validation, settings)
        if best_epochs is not None:
            runs = _exactly(runs, best_epochs[number - 1])
        final = experiment.stages.run(f"{name} {start.model} {start.recipe} {number}", states, runs, settings, splits)
        trained = final.best if best_epochs is None else _where(best_epochs[number - 1] > 0, final.field, fields)
        finals, fields = [*finals, final], trained
    return replace(
        start,
        fields=fields,
        val_loss=np.asarray(finals[-1].best_mse),
        epochs=np.sum([final.epoch for final in finals], axis=0),
        best_epochs=[np.asarray(final.best_epoch) for final in finals],
        status=np.asarray(finals[-1].status),
    )


def rates_of(step: Step, model: str, field: AbstractVectorField) -> dict[str, float]:
    """The learning rate of each group of a field's parameters; 0 for those that the step freezes."""
    learned = eqx.filter(field, trainable(field))
    frozen = [path for path in named_leaves(learned) if path.rpartition("/")[-1] in step.frozen]
    return {**stage_of(step, model).rates, **dict.fromkeys(frozen, 0.0)}


def _run_configs(start: TrainedModel, fields: Any, step: Step, factors: Sequence[float]) -> RunConfig:
    longest = max(map(len, start.subsets))
    one = lane(fields, 0)
    rates = rates_by_group(one, rates_of(step, start.model, one))

    def configure(subset: np.ndarray, factor: float) -> RunConfig:
        stage = stage_of(step, start.model, factor)
        indices = np.resize(subset, longest)  # all of one length; only the first len(subset) are used
        return make_run_config(rates, indices, len(subset), 0, stage.patience, stage.epochs, 0.0)

    runs = [configure(*each) for each in zip(start.subsets, factors, strict=True)]
    return jax.device_get(stack([jax.device_get(run) for run in runs]))


def _exactly(runs: RunConfig, epochs: np.ndarray) -> RunConfig:
    """Make each run take exactly so many epochs, but at least one."""
    exact = np.maximum(epochs, 1).astype(np.int32)
    return eqx.tree_at(lambda run: (run.max_epochs, run.min_epochs), runs, (exact, exact))


def _start_states(fields: Any, seeds: Sequence[int], number: int, validation: Trajectories, settings: Settings):
    def start(field, seed):
        return fitting.start(field, jax.random.fold_in(key_of(seed, ORDER), number))

    states = jax.device_get(eqx.filter_jit(eqx.filter_vmap(start))(fields, np.asarray(seeds)))
    errors = jax.device_get(_errors_at_start(states, validation, settings))
    return eqx.tree_at(lambda state: state.best_mse, states, errors)


@eqx.filter_jit
def _errors_at_start(states: FitState, validation: Trajectories, settings: Settings) -> Float[Array, " runs"]:
    return jax.lax.map(lambda state: judged(state, validation, settings).best_mse, states)


def _where(mask: np.ndarray, new: Any, old: Any) -> Any:
    def pick(new, old):
        return np.where(mask.reshape(-1, *(1,) * (np.ndim(new) - 1)), new, old) if eqx.is_array(new) else new

    return jax.tree.map(pick, new, old)
