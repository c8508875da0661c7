"""Train models in stages: on the source's flights, and on N windows of each fold's flights."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Int

from experiments.real_flight import models
from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.folds import Fold, evenly_spaced, sampled_indices
from experiments.real_flight.logs import LogSet
from experiments.real_flight.models import CHANGE, ORDER, RECIPES, REFERENCE, Step
from experiments.runner.stages import Stages
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.vehicle_file import VehicleModel
from hybrid_jax.flights.windows import LogWindows, cut_windows
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
    config: RealFlightConfig
    before: VehicleModel  # the source's vehicle
    after: VehicleModel  # that of target and test
    logs: Mapping[str, LogSet]  # source and, if given, target and test
    dt: float  # interval between samples [s]
    stages: Stages


@dataclass(frozen=True)
class TrainingData:
    """Windows to train on and to stop by, and the loss; padded to `capacity`, training windows share a program."""

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
    val_loss: Any = ()  # at the best epoch of the last stage
    epochs: Any = ()  # over all stages
    best_epochs: Sequence[np.ndarray] = ()  # of each stage
    status: Any = ()  # of the last stage

    def run(self, index: int) -> AbstractVectorField:
        return lane(self.fields, index)

    def __len__(self) -> int:
        return count(self.fields)

    def size(self, run: int) -> int:
        """The number of target windows that a run was trained on."""
        return len(self.subsets[run]) if self.mode in ("fine_tuned", "scratch") else 0


def training_data(
    experiment: Experiment,
    fold: Fold,
    recipe: str,
    loss: ChannelLoss | None = None,
    stride: int | None = None,
    capacity: int = 0,
) -> TrainingData:
    """Cut the windows of a fold, by default at the source's stride and with a loss scaled by the training windows."""
    how, stride = RECIPES[recipe], stride or experiment.config.stride
    validation = evenly_spaced(cut_windows(fold.validation, how.window).windows, experiment.config.validation)
    train = cut_windows(fold.train, how.window, stride)
    loss = loss or models.objective_of(experiment.before, train.windows, how)
    return TrainingData(train, validation, loss, max(capacity, len(train)))


def train_on_source(
    experiment: Experiment, name: str, model: str, recipe: str, data: TrainingData, seeds: int, best_epochs: Any = ()
) -> TrainedModel:
    """Train a model on all windows before the change, one run per seed; `best_epochs` is that of `in_stages`."""
    config = experiment.config
    fields = models.untrained(model, experiment.before, RECIPES[recipe], config.hidden, seeds, config.activation)
    start = TrainedModel(model, "source_only", recipe, fields, range(seeds), [np.arange(len(data.train))] * seeds)
    frozen = CHANGE if "target" in experiment.logs else ()
    steps = [replace(step, frozen=(*step.frozen, *frozen)) for step in RECIPES[recipe].source]
    return in_stages(experiment, name, start, steps, data, best_epochs)


def refit(experiment: Experiment, name: str, fold: Fold, data: TrainingData, first: TrainedModel) -> TrainedModel:
    """Train a source model again, on the validation flights as well, which can then select nothing.

    Each stage ends after as many epochs as were best in the first training, and its last field counts.
    """
    more = cut_windows(fold.validation, RECIPES[first.recipe].window, experiment.config.stride)
    both = concatenate([data.train.windows, more.windows])
    windows = LogWindows(both, [*data.train.sizes, *more.sizes], data.train.stride)
    data = replace(data, train=windows, capacity=max(data.capacity, len(both)))
    again = train_on_source(experiment, f"{name} again", first.model, first.recipe, data, len(first), first.best_epochs)
    return replace(first, fields=again.fields, epochs=first.epochs + again.epochs)


def transfer(experiment: Experiment, source: TrainedModel) -> TrainedModel:
    return replace(source, mode="zero_shot", fields=models.move_to_vehicle(source.fields, experiment.after.vehicle))


def adapt(
    experiment: Experiment, name: str, mode: str, start: TrainedModel, data: TrainingData, sizes: Sequence[int]
) -> TrainedModel:
    """Train on N windows after the change, from `start` or ("scratch") anew: a run for each size and, in it, seed."""
    config, how = experiment.config, RECIPES[start.recipe]
    fields, steps = start.fields, how.adaptation
    if mode == "scratch":
        anew = config.hidden, len(start), config.activation
        fields, steps = models.untrained(start.model, experiment.after, how, *anew), how.scratch
    seeds = [seed for _ in sizes for seed in start.seeds]
    sizes = [min(size, len(data.train)) for size in sizes]  # fewer where a flight is left out of few
    subsets = [sampled_indices(data.train.sizes, size, config.draw, s) for size in sizes for s in start.seeds]
    begin = TrainedModel(start.model, mode, start.recipe, lane(fields, np.array(seeds)), seeds, subsets)
    return in_stages(experiment, f"{name} {mode}", begin, steps, data, ())


def in_stages(
    experiment: Experiment, name: str, start: TrainedModel, steps: Sequence[Step], data: TrainingData, best_epochs: Any
) -> TrainedModel:
    """Train all runs through the stages; each stage starts from the previous stage's best validation checkpoint.

    With `best_epochs`, of each stage and run, a stage ends after these, with its last fields.
    """
    fields, finals = start.fields, []
    settings = Settings(experiment.config.batch_size, objective=data.objective)
    train = data.train.windows[np.arange(data.capacity) % len(data.train)]
    # With these two, trainings of fewer seeds, or without one of the flights, share the program.
    lanes = experiment.config.seeds * len(start) // len(set(start.seeds))
    listed = data.capacity if start.mode == "source_only" else max(experiment.config.n)
    for number, step in enumerate(steps):
        runs = _run_configs(start, fields, step, listed, experiment.config.epochs)
        splits = Dataset({"train": cut(train, step.steps), "validation": data.validation}, {})
        where = (fields, np.asarray(start.seeds), np.asarray(number + 1))
        states = jax.device_get(_start_states(*where, data.validation, settings))
        if best_epochs:
            exact = np.maximum(best_epochs[number], 1).astype(np.int32)
            runs = eqx.tree_at(lambda run: (run.max_epochs, run.min_epochs), runs, (exact, exact))
        stage = f"{name} {start.model} {start.recipe} {number + 1}"
        finals.append(experiment.stages.sweep(stage, states, runs, settings, splits, (lanes, 0)))
        if best_epochs:
            last = (finals[-1].field if epochs else fields for epochs in best_epochs[number])
            fields = stack([lane(each, run) for run, each in enumerate(last)])
        else:
            fields = finals[-1].best
    val_loss, status = finals[-1].best_mse, finals[-1].status
    epochs, best = np.sum([each.epoch for each in finals], axis=0), [each.best_epoch for each in finals]
    return replace(start, fields=fields, val_loss=val_loss, epochs=epochs, best_epochs=best, status=status)


def _run_configs(start: TrainedModel, fields: Any, step: Step, listed: int, factor: float) -> RunConfig:
    one = lane(fields, 0)
    rates = rates_by_group(one, models.rates_of(step, start.model, one))

    def configure(run: int) -> RunConfig:
        # An epoch of few windows has few gradient steps, so small N are trained for more epochs.
        scale = factor * ((REFERENCE / start.size(run)) ** 0.5 if start.size(run) else 1.0)
        epochs, patience = (max(1, round(scale * count)) for count in (step.epochs, step.patience))
        indices = np.resize(start.subsets[run], listed)  # all of one length; only the first ones are used
        return make_run_config(rates, indices, len(start.subsets[run]), 0, patience, epochs, 0.0)

    return stack([configure(run) for run in range(len(start))])


@eqx.filter_jit
def _start_states(fields: Any, seeds, number, validation: Trajectories, settings: Settings) -> FitState:
    """The state of each run at the start of a stage, with the validation error of its field."""

    def one(run):
        field, seed = run
        state = fitting.start(field, jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), ORDER), number))
        return judged(state, validation, settings)

    return jax.lax.map(one, (fields, seeds))
