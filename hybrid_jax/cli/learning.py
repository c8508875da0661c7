"""Learn a vehicle from flights, with physics only or with a network, for `fit` and experiments."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from hybrid_jax.adaptation import METHODS, Adaptation, Auto, adapt
from hybrid_jax.cli import errors
from hybrid_jax.cli.choice import choose, expected
from hybrid_jax.cli.logs import STEPS, windows_of
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.baselines import FrozenRates
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.disturbance_model import DisturbanceModel
from hybrid_jax.dynamics.vehicle_file import LAG, VehicleModel
from hybrid_jax.estimation import fit_disturbance
from hybrid_jax.flights.checks.cleaning import TIME_CONSTANTS, lag_motors
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.windows import sequences
from hybrid_jax.networks.mlp import InputScaling, zero_output
from hybrid_jax.networks.views import multirotor_network
from hybrid_jax.training import Settings, fit, rates_by_group
from hybrid_jax.training.channels import scaled_loss
from hybrid_jax.trajectories import Trajectories, split

TRAINED, VALIDATED, ADAPTED, OF_LAG, KEPT = 2000, 500, 600, 300, 50  # windows at most
FOLDS = 3  # at most so many groups of flights are left out in turn
HIDDEN, RATE, EPOCHS = 32, 3e-3, 60
PHYSICS, OUTPUTS = "theta_least_squares", "accelerations"
PAST = " with its past"  # of a candidate that also predicts its disturbance from the errors before
FROZEN, CANDIDATES = "thrust, rates frozen", ("physics", "hybrid", f"physics{PAST}", f"hybrid{PAST}")  # simplest first


class Learned(NamedTuple):
    """A learned model of a vehicle.

    Attributes:
        field: the model.
        physics: the identified physics without the network, with intervals.
        chosen: one of CANDIDATES.
        lag: rotor lag relative to the logged motors [s].
        left_out: RMSE of FROZEN and each candidate on held-out flights, after each interval.
        windows: some of those that it was learned from, by which `adapt` judges its errors without any change.
        expected: expected error on a new flight, in `errors.UNITS`: value, low, high.
    """

    field: AbstractVectorField
    physics: Adaptation
    chosen: str
    lag: float
    left_out: dict[str, Float[np.ndarray, "flights t 4"]]
    windows: Trajectories
    expected: Float[np.ndarray, "3 4"]


def learn(model: VehicleModel, logs: Sequence[FlightLog], seed: int = 0) -> Learned:
    """Learn from all flights (two or more), and choose by held-out flights whether to add a network to the physics."""
    lag = _lag(model, logs) if LAG in model.learn else model.terms.motor_time_constant
    logs = lagged(logs, lag)
    # One scale of errors for all flights, so that all trainings share a program.
    settings = Settings(objective=scaled_loss(model.physics(), _windows(logs, TRAINED)))
    parts: dict[str, list[Float[np.ndarray, "f t 4"]]] = {name: [] for name in (FROZEN, *CANDIDATES)}
    groups = [range(i, len(logs), min(FOLDS, len(logs))) for i in range(min(FOLDS, len(logs)))]
    for group in groups:
        kept = [log for i, log in enumerate(logs) if i not in group]
        train = _windows(kept, TRAINED)
        physics = METHODS[PHYSICS].solve(model.physics(), train, train, settings).field
        both = physics, _hybrid(physics, kept, seed, settings)
        fields = FrozenRates(model.physics()), *both, *(with_past(field, kept) for field in both)
        for name, field in zip(parts, fields, strict=True):
            parts[name].append(errors.rmse_by_flight(field, [logs[i] for i in group], STEPS))
    order = np.argsort(np.concatenate(groups))
    found = {name: np.concatenate(each)[order] for name, each in parts.items()}
    ends = {name: each[:, -1] for name, each in found.items()}
    chosen = choose({name: np.log(ends[name] / ends[FROZEN]).mean(axis=1) for name in CANDIDATES})
    windows = windows_of(logs, STEPS, STEPS, TRAINED).windows
    physics = adapt(model.physics(), windows, method=PHYSICS, settings=settings)
    field = physics.field if chosen.startswith("physics") else _hybrid(physics.field, logs, seed, settings)
    field = with_past(field, logs) if chosen.endswith(PAST) else field
    kept = windows_of(logs, STEPS, STEPS, KEPT).windows
    return Learned(field, physics, chosen, lag, found, kept, expected(np.log(ends[chosen])))


def adapted(
    field: AbstractVectorField, logs: Sequence[FlightLog], learned_from: Trajectories | None, most: int = ADAPTED
) -> tuple[AbstractVectorField, Adaptation]:
    """Adapt the physics of a model to at most `most` windows of flights after a change, and what it has of the past.

    Also return the adaptation of the model without its past.
    """
    windows = windows_of(logs, STEPS, STEPS, most).windows
    found = adapt(without_past(field), windows, method=Auto(networks=False), learned_from=learned_from)
    if not isinstance(field, DisturbanceModel):
        return found.field, found
    return with_past(eqx.tree_at(lambda model: model.field, field, found.field), logs, most * STEPS), found


def with_past(field: AbstractVectorField, logs: Sequence[FlightLog], most: int | None = None) -> DisturbanceModel:
    """Add a model of the disturbance, learned from at most `most` intervals of flights."""
    kept, left = [], most or sum(map(len, logs))
    for each in sequences(logs, 2 * STEPS):
        if left > 2 * STEPS:
            kept.append(split(each, left)[0] if left < each.horizon else each)
            left -= each.horizon
    return fit_disturbance(field, kept, steps=STEPS)


def without_past(field: AbstractVectorField) -> AbstractVectorField:
    return field.field if isinstance(field, DisturbanceModel) else field


def lagged(logs: Sequence[FlightLog], lag: float) -> list[FlightLog]:
    """Apply a rotor lag [s] to the motors of flights."""
    return [lag_motors(log, lag) for log in logs] if lag else list(logs)


def _lag(model: VehicleModel, logs: Sequence[FlightLog]) -> float:
    """Find the lag with which physics fitted to all but the last flight predicts that flight best."""

    def error(lag: float) -> float:
        flights = lagged(logs, lag)
        train = _windows(flights[:-1], OF_LAG)
        settings = Settings(objective=scaled_loss(model.physics(), train))
        field = METHODS[PHYSICS].solve(model.physics(), train, train, settings).field
        ends = [
            errors.rmse_by_flight(each, flights[-1:], STEPS)[:, -1] for each in (field, FrozenRates(model.physics()))
        ]
        return float(np.log(ends[0] / ends[1]).mean())

    found = {lag: off for lag in TIME_CONSTANTS if np.isfinite(off := error(lag))}
    if not found:
        raise ValueError("no time constant of the rotors has a finite error, so none can be chosen")
    return min(found, key=lambda lag: found[lag])


def _windows(logs: Sequence[FlightLog], count: int) -> Trajectories:
    """Select evenly spaced windows, repeated if there are fewer, so that trainings share a compiled program."""
    windows = windows_of(logs, STEPS, 1, count).windows
    return windows[np.arange(count) % len(windows)]


def _hybrid(physics: Any, logs: Sequence[FlightLog], seed: int, settings: Settings) -> AbstractVectorField:
    """Add a network for accelerations to physics; with three flights or more, the last is used for early stopping."""
    learned, validating = (logs[:-1], logs[-1:]) if len(logs) > 2 else (logs, logs)
    vehicle, key = physics.vehicle, jax.random.key(seed)
    scaling = InputScaling(vehicle.hover_speed, vehicle.hover_speed / 10)
    options: dict[str, Any] = {"hidden": HIDDEN, "norm": "none", "scaling": scaling}
    residual = zero_output(multirotor_network(vehicle, key, inputs="body_motion", outputs=OUTPUTS, **options))
    field = Hybrid(physics, residual)
    train, validation = _windows(learned, TRAINED), _windows(validating, VALIDATED)
    rates = rates_by_group(field, {"residual": RATE})
    return fit(field, train, validation, key, rates=rates, min_epochs=0, max_epochs=EPOCHS, settings=settings).best
