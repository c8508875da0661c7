"""Models tested on flights that they have not seen, and the rows that they make."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from experiments.real_flight.config import NANODRONE_STEPS, RealFlightConfig
from experiments.real_flight.folds import Fold, apart
from experiments.real_flight.logs import Windows, cut
from experiments.real_flight.models import Lane, Trained
from experiments.real_flight.rows import QUANTITIES, SUM, FlightRow, finite
from hybrid_jax.adaptation import least_squares, ridge
from hybrid_jax.adaptation.uncertainty import covariance_of, intervals
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid
from hybrid_jax.dynamics.multirotor import Multirotor
from hybrid_jax.flights.scores import FlightErrors, flight_errors, mean_by_step
from hybrid_jax.sweep.lanes import count, lane, stack
from hybrid_jax.training import stages
from hybrid_jax.training.channels import ChannelLoss
from hybrid_jax.training.fitting import STATUS_NAMES, STOPPED
from hybrid_jax.trajectories import Trajectories

INTERVAL_STEPS = 10  # of the windows that intervals of θ_p are made from: many of them are independent
ROUND = 25  # their number is a multiple of it
ADAPTED = ("fine_tuned", "scratch")


@dataclass(frozen=True)
class Trial:
    """What was tested in one fold: which windows, under which options.

    Attributes:
        windows: from every sample of the test flights, as long as the longest horizon.
    """

    fold: Fold
    windows: Trajectories
    config: RealFlightConfig


@dataclass(frozen=True)
class Scored:
    """A row, and its errors at every step: RMS and mean over windows, (4, t) in the order of QUANTITIES."""

    row: FlightRow
    rms: np.ndarray
    mean: np.ndarray


def trial_of(fold: Fold, config: RealFlightConfig) -> Trial:
    """The fold's test windows."""
    return Trial(fold, cut(fold.test, config.longest).windows, config)


def score(trial: Trial, field: AbstractVectorField, **known: Any) -> Scored:
    """A field, tested.

    Args:
        known: the row's other attributes.
    """
    errors = flight_errors(field, trial.windows)
    rms = np.array([np.sqrt(np.mean(np.square(part, dtype=float), axis=0)) for part in errors])
    mean = np.array(mean_by_step(errors))
    row = FlightRow(fold=trial.fold.name, windows=len(trial.windows), scores=scores(rms, mean, trial.config), **known)
    return Scored(row, rms, mean)


def scores(rms: np.ndarray, mean: np.ndarray, config: RealFlightConfig) -> Mapping[str, Mapping[str, float | None]]:
    """RMSE at each horizon and, by the nanodrone protocol, the mean errors of 50 steps, summed."""
    found = {str(steps): rms[:, steps - 1] for steps in config.horizon}
    if config.protocol == "nanodrone":
        found[SUM] = mean[:, :NANODRONE_STEPS].sum(axis=1)
    return {label: dict(zip(QUANTITIES, map(finite, values), strict=True)) for label, values in found.items()}


def score_lanes(
    trial: Trial,
    model: str,
    mode: str,
    recipe: str,
    lanes: Sequence[Lane],
    trained: Trained,
    parameters: Sequence[Mapping[str, Any]],
) -> list[Scored]:
    """All lanes of a model, tested.

    Args:
        parameters: of each lane, from `parameters`.
    """

    def known(index: int, each: Lane) -> dict[str, Any]:
        return {
            "n_train": len(each.subset) if mode in ADAPTED else 0,
            "seed": each.seed,
            "recipe": recipe,
            "val_loss": finite(trained.val_loss[index]),
            "epochs": int(trained.epochs[index]),
            "status": STATUS_NAMES.get(int(trained.status[index]), STATUS_NAMES[STOPPED]),
            **parameters[index],
        }

    return [
        score(trial, lane(trained.fields, index), model=model, mode=mode, **known(index, each))
        for index, each in enumerate(lanes)
    ]


def parameters(fields: Any, lanes: Sequence[Lane], training: Windows, objective: ChannelLoss) -> list[dict[str, Any]]:
    """θ_p of each lane and its intervals, from those of its windows that share no sample, as the loss counts errors."""
    if not any(map(_is_body, jax.tree.leaves(fields, is_leaf=_is_body))):
        return [{} for _ in lanes]
    short = stages.cut(training.windows, min(INTERVAL_STEPS, training.windows.horizon))
    spacing = -(-short.horizon // training.stride)
    found: list[dict[str, Any]] = []
    # Lanes of one size are a program together; a round number of windows is the same for most sizes and folds.
    for _, group in groupby(range(len(lanes)), lambda index: len(lanes[index].subset)):
        indices = list(group)
        own = [apart(lanes[index].subset, training.sizes, spacing) for index in indices]
        most = min(map(len, own)) // ROUND * ROUND
        places = stack([each[np.linspace(0, len(each) - 1, most).round().astype(int)] for each in own])
        found += _parameters(lane(fields, np.array(indices)), places, short, objective)
    return found


def _parameters(fields: Any, own: np.ndarray, windows: Trajectories, objective: ChannelLoss):
    """θ_p alone where there are no more windows than parameters."""
    enough = own.shape[1] > least_squares.ravel_parameters(lane(fields, 0))[0].size
    ends = jax.device_get(_intervals(fields, own, windows, objective) if enough else _values(fields))

    def one(index: int) -> dict[str, Any]:
        theta = {name: finite(interval.value[index]) for name, interval in ends.items()}
        around = {name: [finite(end[index]) for end in (at.low, at.high)] for name, at in ends.items()}
        return {"theta": theta, "theta_interval": around if enough else None}

    return [one(index) for index in range(len(own))]


@eqx.filter_jit
def _intervals(fields: Any, own: Int[np.ndarray, "lanes n"], windows: Trajectories, objective: ChannelLoss):
    def one(lane):
        field, places = lane
        return intervals(body_of(field), covariance_of(field, windows[places], error=objective.error))

    return jax.lax.map(one, (fields, own))


@eqx.filter_jit
def _values(fields: Any):
    def one(field):
        body = body_of(field)
        size = least_squares.ravel_parameters(body)[0].size
        return intervals(body, jnp.zeros((size, size)))

    return jax.lax.map(one, fields)


def body_of(field: AbstractVectorField) -> Multirotor:
    """The multirotor inside a field that has one; all that its physics learns."""
    return next(filter(_is_body, jax.tree.leaves(field, is_leaf=_is_body)))


def _is_body(node: Any) -> bool:
    return isinstance(node, Multirotor)


def linear_residuals(
    base: AbstractVectorField, windows: Trajectories, subsets: Sequence[np.ndarray], validation: Trajectories
) -> Any:
    """Stacked fields: the base plus a linear residual, fitted to each subset of the windows (all of one size)."""
    return jax.device_get(_linear_residuals(base, windows, stack(list(subsets)), validation))


@eqx.filter_jit
def _linear_residuals(base, windows: Trajectories, subsets: Int[np.ndarray, "lanes n"], validation: Trajectories):
    def one(subset):
        return ridge.fit_ridge(ridge.linear_residual, base, windows[subset], validation).field

    return jax.lax.map(one, subsets)


def on(base: AbstractVectorField, linear: Any) -> list[AbstractVectorField]:
    """The linear residuals of stacked fields on another base."""
    return [Hybrid(base, lane(linear, index).residual) for index in range(count(linear.residual))]


def relative_error(errors: FlightErrors, baseline: FlightErrors, horizons: Sequence[int]) -> float:
    """The mean over quantities and horizons of RMSE over a baseline's: what a recipe is chosen by."""

    def rms(part, steps: int) -> float:
        return float(np.sqrt(np.mean(np.square(part[:, steps - 1], dtype=float))))

    pairs = [(own, other, steps) for own, other in zip(errors, baseline, strict=True) for steps in horizons]
    return float(np.mean([rms(own, steps) / rms(other, steps) for own, other, steps in pairs]))
