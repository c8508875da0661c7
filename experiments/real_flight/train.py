"""Train models in stages: on the source's flights, and on N windows of each fold's flights."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Int

from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.folds import Fold, evenly_spaced, padded, sampled_indices
from experiments.real_flight.logs import LogSet
from experiments.real_flight.models import ORDER, key_of, move_to_vehicle, objective_of, untrained
from experiments.real_flight.recipes import CHANGE, RECIPES, Step, epoch_factor, stage_of
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

Counts = Int[np.ndarray, " runs"]


@dataclass(frozen=True)
class Experiment:
    """What an experiment is given."""

    config: RealFlightConfig
    before: VehicleModel  # the source's vehicle
    after: VehicleModel  # that of target and test
    logs: Mapping[str, LogSet]  # source and, if given, target and test
    dt: float  # interval between samples [s]
    stages: Stages


@dataclass(frozen=True)
class TrainingData:
    """Windows to train on and to stop by, and the loss; training windows are padded to `capacity`."""

    train: LogWindows
    validation: Trajectories
    objective: ChannelLoss
    capacity: int


@dataclass(frozen=True)
class TrainedModel:
    """The runs of one model, one per seed and number of windows."""

    model: str
    mode: str
    recipe: str
    fields: Any  # stacked
    seeds: Sequence[int]
    subsets: Sequence[Int[np.ndarray, " n"]]  # indices of the training windows
    val_loss: np.ndarray = field(default_factory=partial(np.zeros, 0))  # at the best epoch of the last stage
    epochs: Counts = field(default_factory=partial(np.zeros, 0, int))  # over all stages
    best_epochs: Sequence[Counts] = ()  # of each stage
    status: Counts = field(default_factory=partial(np.zeros, 0, int))  # of the last stage

    def run(self, index: int) -> AbstractVectorField:
        """The field of one run."""
        return lane(self.fields, index)

    def __len__(self) -> int:
        return count(self.fields)

    def size(self, run: int) -> int:
        """The number of target windows that a run was trained on."""
        return len(self.subsets[run]) if self.mode in ("fine_tuned", "scratch") else 0


def training_data(
    experiment: Experiment, fold: Fold, recipe: str, source: TrainingData | None = None, capacity: int = 0
) -> TrainingData:
    """Cut the windows of a fold; the loss is scaled by its training windows.

    After a change, `source` are the data before it: its loss is used, and a window starts at every sample.
    """
    how, config = RECIPES[recipe], experiment.config
    validation = evenly_spaced(cut_windows(fold.validation, how.window).windows, config.validation)
    train = cut_windows(fold.train, how.window, 1 if source else config.stride)
    loss = source.objective if source else objective_of(experiment.before, train.windows, how)
    return TrainingData(train, validation, loss, capacity or len(train))


def train_on_source(
    experiment: Experiment,
    name: str,
    model: str,
    recipe: str,
    data: TrainingData,
    seeds: int,
    best_epochs: Sequence[Counts] | None = None,
) -> TrainedModel:
    """Train a model on all windows before the change, one run per seed; `best_epochs` is that of `in_stages`."""
    how = RECIPES[recipe]
    fields = untrained(model, experiment.before, how, experiment.config.hidden, seeds)
    start = TrainedModel(model, "source_only", recipe, fields, range(seeds), [np.arange(len(data.train))] * seeds)
    frozen = CHANGE if "target" in experiment.logs else ()
    steps = [replace(step, frozen=(*step.frozen, *frozen)) for step in how.source]
    return in_stages(experiment, name, start, steps, data, best_epochs)


def refit(experiment: Experiment, name: str, fold: Fold, data: TrainingData, first: TrainedModel) -> TrainedModel:
    """Train a source model again, on the validation flights as well.

    Each stage ends after as many epochs as were best in the first training, and its last field counts: the validation
    windows are trained on, so they can select nothing.
    """
    more = cut_windows(fold.validation, RECIPES[first.recipe].window, experiment.config.stride)
    both = concatenate([data.train.windows, more.windows])
    windows = LogWindows(both, [*data.train.sizes, *more.sizes], data.train.stride)
    data = replace(data, train=windows, capacity=len(both))
    again = train_on_source(experiment, f"{name} again", first.model, first.recipe, data, len(first), first.best_epochs)
    return replace(first, fields=again.fields, epochs=first.epochs + again.epochs)


def transfer(experiment: Experiment, source: TrainedModel) -> TrainedModel:
    """Move a source model to the vehicle after the change, without training."""
    return replace(source, mode="zero_shot", fields=move_to_vehicle(source.fields, experiment.after.vehicle))


def adapt(
    experiment: Experiment, name: str, mode: str, start: TrainedModel, data: TrainingData, sizes: Sequence[int]
) -> TrainedModel:
    """Train a model on N windows after the change, one run for each size and seed, in this order.

    "fine_tuned" starts from the fields of `start`, "scratch" from untrained ones.
    """
    config, how, fields, steps = (
        experiment.config,
        RECIPES[start.recipe],
        start.fields,
        RECIPES[start.recipe].adaptation,
    )
    if mode == "scratch":
        fields, steps = untrained(start.model, experiment.after, how, config.hidden, len(start)), how.scratch
    seeds = [seed for _ in sizes for seed in start.seeds]
    subsets = [sampled_indices(data.train.sizes, size, config.draw, s) for size in sizes for s in start.seeds]
    begin = TrainedModel(start.model, mode, start.recipe, lane(fields, np.array(seeds)), seeds, subsets)
    return in_stages(experiment, f"{name} {mode}", begin, steps, data)


def in_stages(
    experiment: Experiment,
    name: str,
    start: TrainedModel,
    steps: Sequence[Step],
    data: TrainingData,
    best_epochs: Sequence[Counts] | None = None,
) -> TrainedModel:
    """Train all runs through the stages; each stage starts from the previous stage's best validation checkpoint.

    With `best_epochs`, of each stage and run, a stage ends after these, with its last fields.
    """
    config, fields, finals = experiment.config, start.fields, []
    settings = Settings(config.batch_size, objective=data.objective)
    train = padded(data.train.windows, data.capacity)
    sizes = map(start.size, range(len(start)))
    factors = [config.epochs * (epoch_factor(size) if size else 1.0) for size in sizes]
    for number, step in enumerate(steps, 1):
        runs = _run_configs(start, fields, step, factors)
        splits = Dataset({"train": cut(train, step.steps), "validation": data.validation}, {})
        where = (fields, np.asarray(start.seeds), np.asarray(number))
        states = jax.device_get(_start_states(*where, data.validation, settings))
        if best_epochs is not None:
            exact = np.maximum(best_epochs[number - 1], 1).astype(np.int32)
            runs = eqx.tree_at(lambda run: (run.max_epochs, run.min_epochs), runs, (exact, exact))
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
    longest, one = max(map(len, start.subsets)), lane(fields, 0)
    rates = rates_by_group(one, rates_of(step, start.model, one))

    def configure(subset: np.ndarray, factor: float) -> RunConfig:
        stage = stage_of(step, start.model, factor)
        indices = np.resize(subset, longest)  # all of one length; only the first len(subset) are used
        return make_run_config(rates, indices, len(subset), 0, stage.patience, stage.epochs, 0.0)

    return stack([configure(*each) for each in zip(start.subsets, factors, strict=True)])


@eqx.filter_jit
def _start_states(fields: Any, seeds: Counts, number, validation: Trajectories, settings: Settings) -> FitState:
    """The state of each run at the start of a stage, with the validation error of its field."""

    def one(run):
        field, seed = run
        state = fitting.start(field, jax.random.fold_in(key_of(seed, ORDER), number))
        return judged(state, validation, settings)

    return jax.lax.map(one, (fields, seeds))


def _where(mask: np.ndarray, new: Any, old: Any) -> Any:
    def pick(new, old):
        return np.where(mask.reshape(-1, *(1,) * (np.ndim(new) - 1)), new, old) if eqx.is_array(new) else new

    return jax.tree.map(pick, new, old)
