"""Test models on held-out flights, and estimate their physical parameters."""

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from experiments.real_flight.config import NANODRONE_STEPS, RealFlightConfig
from experiments.real_flight.folds import non_overlapping
from experiments.real_flight.models import is_body
from experiments.real_flight.rows import QUANTITIES, SUM
from experiments.real_flight.train import TrainedModel, TrainingData
from hybrid_jax.adaptation.least_squares import ravel_parameters
from hybrid_jax.adaptation.ridge import fit_ridge, linear_residual
from hybrid_jax.adaptation.uncertainty import covariance_of, intervals
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid
from hybrid_jax.dynamics.multirotor import Multirotor
from hybrid_jax.flights.scores import FlightErrors, flight_errors
from hybrid_jax.sweep.lanes import lane, stack
from hybrid_jax.training.channels import ChannelLoss
from hybrid_jax.training.fitting import STATUS_NAMES, STOPPED
from hybrid_jax.training.stages import cut
from hybrid_jax.trajectories import Trajectories

INTERVAL_STEPS = 10  # length of the windows that intervals of θ_p come from: short, so that many are independent
ROUND = 25  # their number is a multiple of it

Test = tuple[dict[str, Any], np.ndarray]  # a row, and its errors at every step: RMS and mean over windows, (2, 4, t)


def score(
    field: AbstractVectorField, *, windows: Trajectories, config: RealFlightConfig, fold: str, **columns: Any
) -> Test:
    """Test a field; `columns` are further columns of the row."""
    errors = flight_errors(field, windows)
    rms = np.array([np.sqrt(np.mean(np.square(part, dtype=float), axis=0)) for part in errors])
    mean = np.array([np.mean(part, axis=0, dtype=float) for part in errors])
    row = {"fold": fold, "model": "", "mode": "", "n_train": 0, "seed": 0, "recipe": "", "windows": len(windows)}
    row |= {"val_loss": None, "epochs": 0, "status": "ok", "scores": scores(rms, mean, config)}
    row |= {"theta": None, "theta_interval": None}
    return row | columns, np.stack([rms, mean])


def scores(rms: np.ndarray, mean: np.ndarray, config: RealFlightConfig) -> Mapping[str, Mapping[str, float]]:
    """Pick the RMSE at each horizon and, with the nanodrone protocol, the mean errors of 50 steps, summed."""
    found = {str(steps): rms[:, steps - 1] for steps in config.horizon}
    if config.protocol == "nanodrone":
        found[SUM] = mean[:, :NANODRONE_STEPS].sum(axis=1)
    return {label: dict(zip(QUANTITIES, values, strict=True)) for label, values in found.items()}


def score_model(scoring: Callable[..., Test], trained: TrainedModel, theta: Sequence[Mapping[str, Any]]):
    """Test all runs of a model by `score` with a fold's arguments; `theta` is what `parameters` found."""
    for run in range(len(trained)):
        columns = {"model": trained.model, "mode": trained.mode, "recipe": trained.recipe, **theta[run]}
        columns |= {"n_train": trained.size(run), "seed": trained.seeds[run], "epochs": int(trained.epochs[run])}
        status = STATUS_NAMES.get(int(trained.status[run]), STATUS_NAMES[STOPPED])
        yield scoring(trained.run(run), **columns, val_loss=trained.val_loss[run], status=status)


def parameters(trained: TrainedModel, data: TrainingData) -> list[dict[str, Any]]:
    """Estimate θ_p of each run, and its intervals if enough of its training windows share no sample."""
    if not any(map(is_body, jax.tree.leaves(trained.fields, is_leaf=is_body))):
        return [{} for _ in trained.seeds]
    short = _short(data)
    spacing = -(-short.horizon // data.train.stride)
    learned = ravel_parameters(trained.run(0))[0].size
    found: list[dict[str, Any]] = []
    # Runs of one size share a program; rounding the number of windows lets sizes and folds share one too.
    for _, group in groupby(range(len(trained)), lambda run: len(trained.subsets[run])):
        runs = list(group)
        own = [non_overlapping(trained.subsets[run], data.train.sizes, spacing) for run in runs]
        most = min(map(len, own)) // ROUND * ROUND
        picked = stack([each[np.linspace(0, len(each) - 1, most).round().astype(int)] for each in own])
        bounded = most > learned
        of = lane(trained.fields, np.array(runs))
        ends = jax.device_get(_intervals(of, picked if bounded else picked[:, :0], short, data.objective))
        for run in range(len(runs)):
            theta = {name: at.value[run] for name, at in ends.items()}
            around = {name: [at.low[run], at.high[run]] for name, at in ends.items()}
            found.append({"theta": theta, "theta_interval": around if bounded else None})
    return found


@eqx.filter_jit
def _intervals(fields: Any, picked: Int[np.ndarray, "runs n"], windows: Trajectories, objective: ChannelLoss):
    """θ_p of each run and its intervals, of no width without windows."""

    def one(run):
        field, indices = run
        if len(indices):
            return intervals(body_of(field), covariance_of(field, windows[indices], error=objective.error))
        return intervals(body_of(field), jnp.zeros((ravel_parameters(body_of(field))[0].size,) * 2))

    return jax.lax.map(one, (fields, picked))


def body_of(field: AbstractVectorField) -> Multirotor:
    """Return the multirotor inside a field, which holds all that its physics learns."""
    return next(filter(is_body, jax.tree.leaves(field, is_leaf=is_body)))


def linear_residuals(
    base: AbstractVectorField, data: TrainingData, subsets: Sequence[np.ndarray], test_base: AbstractVectorField
) -> list[AbstractVectorField]:
    """Fit a linear residual of `base` to each subset of the training windows, of one size; add it to `test_base`."""
    fitted = jax.device_get(_linear_residuals(base, _short(data), stack(list(subsets)), data.validation))
    return [Hybrid(test_base, lane(fitted, run).residual) for run in range(len(subsets))]


@eqx.filter_jit
def _linear_residuals(base, windows: Trajectories, subsets: Int[np.ndarray, "runs n"], validation: Trajectories):
    return jax.lax.map(lambda subset: fit_ridge(linear_residual, base, windows[subset], validation).field, subsets)


def _short(data: TrainingData) -> Trajectories:
    return cut(data.train.windows, min(INTERVAL_STEPS, data.train.windows.horizon))


def relative_error(errors: FlightErrors, baseline: FlightErrors, horizons: Sequence[int]) -> float:
    """Average RMSE over that of a baseline, over quantities and horizons; recipes are chosen by it."""

    def rms(part, steps: int) -> float:
        return float(np.sqrt(np.mean(np.square(part[:, steps - 1], dtype=float))))

    pairs = zip(errors, baseline, strict=True)
    return float(np.mean([rms(own, steps) / rms(other, steps) for own, other in pairs for steps in horizons]))
