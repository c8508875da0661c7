"""Learn a vehicle from flights, with physics only or with a network, adapt it after a change, and score predictions."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hybrid_jax.adaptation import METHODS, Adaptation, adapt
from hybrid_jax.adaptation.expectation import expected
from hybrid_jax.dynamics import AbstractVectorField, DisturbanceModel, Hybrid
from hybrid_jax.dynamics.rigid_body import LEARNED, FrozenRates
from hybrid_jax.dynamics.terms import OF_VELOCITY, shape_of
from hybrid_jax.dynamics.vehicle_file import LAG, LEARN, VehicleModel
from hybrid_jax.estimation import fit_disturbance, observe
from hybrid_jax.flights.checks.cleaning import TIME_CONSTANTS, lag_motors
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.windows import cut_windows, flight_errors, sequences
from hybrid_jax.networks.mlp import InputScaling, zero_output
from hybrid_jax.networks.views import multirotor_network
from hybrid_jax.training import Settings, fit, rates_by_group
from hybrid_jax.training.objective import scaled_loss
from hybrid_jax.trajectories import Trajectories, concatenate, split, windows_of

UNITS = {"position": "m", "velocity": "m/s", "rotation": "rad", "body_rates": "rad/s"}  # of prediction errors
STEPS = 10  # intervals of a window
TRAINED, VALIDATED, OF_LAG, KEPT = 2000, 500, 300, 50  # windows at most
ENOUGH = 10  # windows for each parameter that is learned by default; with fewer, its error exceeds its effect
NAMES = "position", "velocity", "attitude", "body rates"  # of a rigid body's quantities, in the order of `UNITS`
FOLDS = 3  # groups of flights that are left out in turn, at most
HIDDEN, RATE, EPOCHS = 32, 3e-3, 60
PHYSICS, OUTPUTS = "theta_least_squares", "accelerations"
PAST = " with its past"  # names a candidate that also predicts its disturbance from earlier errors
FROZEN, CANDIDATES = "thrust, rates frozen", ("physics", "hybrid", f"physics{PAST}", f"hybrid{PAST}")  # simplest first


class Learned(NamedTuple):
    """A learned model of a vehicle.

    Attributes:
        field: the model.
        physics: the fit of the physics without the network, with intervals.
        chosen: the chosen candidate, one of `CANDIDATES`.
        lag: the time constant of the rotors behind the logged motors [s].
        left_out: RMSE of frozen rates and of each candidate on held-out flights after each interval of `dt`, in the
            units of `prediction_errors.UNITS`.
        windows: some training windows, from which `adapted` estimates the model's errors without a change.
        expected: the error on a new flight after `STEPS` intervals: value, low and high end of the 80 % interval.
    """

    field: AbstractVectorField
    physics: Adaptation
    chosen: str
    lag: float
    left_out: dict[str, Float[np.ndarray, "flights t 4"]]
    windows: Trajectories
    expected: Float[np.ndarray, "3 4"]


def learnable(model: VehicleModel, seconds: float, window: float, moves: bool = True) -> tuple[VehicleModel, str]:
    """Return the model without the default parameters that the logs do not determine, and a line that names them.

    `seconds` is the time in flight in all logs, `window` the length of a window [s], and `moves` is whether logs have a
    velocity. The model does not change if its file or the user names the parameters to learn.
    """
    if model.learn != LEARN:
        return model, ""
    learned, why = tuple(name for name in LEARN if moves or name not in OF_VELOCITY), ""
    needed = ENOUGH * window * sum(np.prod(shape_of(model.vehicle, name)) for name in learned)
    if seconds < needed:
        learned, why = LEARNED, f"{seconds:.2g} s of flight are too few, {needed:.2g} s are needed"
    elif not moves:
        why = "not all logs have a velocity"
    left = ", ".join(name for name in LEARN if name not in learned)
    return replace(model, learn=learned), why and f"Not learned, as {why}: {left}."


def learn(model: VehicleModel, logs: Sequence[FlightLog], seed: int = 0) -> Learned:
    """Learn a vehicle from all flights, with a network added to the physics if it is better on held-out flights.

    Args:
        model: the vehicle and the names of its parameters to learn.
        logs: two or more flights with one sample interval, checked, without time on the ground.
        seed: the random seed of the network.
    """
    lag = _lag(model, logs) if LAG in model.learn else model.terms.motor_time_constant
    logs = [lag_motors(log, lag) for log in logs]
    # One scale of errors and number of windows for all flights, so that all trainings share a program.
    settings = Settings(objective=scaled_loss(model.physics(), _windows(logs, TRAINED)))
    windows = cut_windows(logs, STEPS, STEPS, TRAINED)
    parts: dict[str, list[Float[np.ndarray, "f t 4"]]] = {name: [] for name in (FROZEN, *CANDIDATES)}
    groups = [range(i, len(logs), min(FOLDS, len(logs))) for i in range(min(FOLDS, len(logs)))]
    for group in groups:
        kept = [log for i, log in enumerate(logs) if i not in group]
        train = _windows(kept, len(windows), STEPS)
        physics = METHODS[PHYSICS].solve(model.physics(), train, train, settings).field
        both = physics, _hybrid(physics, kept, seed, settings)
        fields = FrozenRates(model.physics()), *both, *(with_past(field, kept) for field in both)
        for name, field in zip(parts, fields, strict=True):
            parts[name].append(rmse_by_flight(field, [logs[i] for i in group], STEPS))
    order = np.argsort(np.concatenate(groups))
    found = {name: np.concatenate(each)[order] for name, each in parts.items()}
    ends = {name: each[:, -1] for name, each in found.items()}
    chosen = choose({name: np.log(ends[name] / ends[FROZEN]).mean(axis=1) for name in CANDIDATES})
    physics = adapt(model.physics(), windows, method=PHYSICS, settings=settings)
    field = physics.field if chosen.startswith("physics") else _hybrid(physics.field, logs, seed, settings)
    field = with_past(field, logs) if chosen.endswith(PAST) else field
    kept = cut_windows(logs, STEPS, STEPS, KEPT)
    return Learned(field, physics, chosen, lag, found, kept, expected(np.log(ends[chosen])))


def with_past(field: AbstractVectorField, logs: Sequence[FlightLog], most: int | None = None) -> DisturbanceModel:
    """Add a model of the disturbance, learned from at most `most` intervals of flights."""
    return fit_disturbance(field, first_intervals(sequences(logs, 2 * STEPS), most), steps=STEPS)


def first_intervals(flights: Sequence[Trajectories], most: int | None) -> list[Trajectories]:
    kept, left = [], most or sum(each.horizon for each in flights)
    for each in flights:
        if left > 2 * STEPS:
            kept.append(split(each, left)[0] if left < each.horizon else each)
            left -= each.horizon
    return kept


def without_past(field: AbstractVectorField) -> AbstractVectorField:
    return field.field if isinstance(field, DisturbanceModel) else field


def _lag(model: VehicleModel, logs: Sequence[FlightLog]) -> float:
    """Find the lag with which physics fitted to all but the last flight predicts that flight best."""

    def error(lag: float) -> float:
        flights = [lag_motors(log, lag) for log in logs]
        train = _windows(flights[:-1], OF_LAG)
        settings = Settings(objective=scaled_loss(model.physics(), train))
        field = METHODS[PHYSICS].solve(model.physics(), train, train, settings).field
        ends = [rmse_by_flight(each, flights[-1:], STEPS)[:, -1] for each in (field, FrozenRates(model.physics()))]
        return float(np.log(ends[0] / ends[1]).mean())

    found = {lag: off for lag in TIME_CONSTANTS if np.isfinite(off := error(lag))}
    if not found:
        raise ValueError("predictions diverge with every time constant of the rotors; check their speeds")
    return min(found, key=lambda lag: found[lag])


def _windows(logs: Sequence[FlightLog], count: int, stride: int = 1) -> Trajectories:
    """Select evenly spaced windows, repeated if there are fewer, so that trainings share a compiled program."""
    windows = cut_windows(logs, STEPS, stride, count)
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


def choose(scores: Mapping[str, Float[np.ndarray, " flights"]]) -> str:
    """Choose a candidate by its log-errors on held-out flights; the first is the baseline, and the simplest are first.

    A model should be reliable on new flights, so a candidate that is worse than the baseline on any flight is rejected.
    Of the others, the simplest within one standard error of the smallest mean is chosen, by paired differences
    (Breiman et al., "Classification and regression trees", 1984). Each flight counts once, because its windows share
    wind, battery and manoeuvre.
    """
    baseline = next(iter(scores.values()))
    considered = {name: each for name, each in scores.items() if np.isfinite(each).all() and (each <= baseline).all()}
    best = min(considered.values(), key=np.mean)
    worse = {name: each - best for name, each in considered.items()}
    error = {name: each.std(ddof=1) / len(each) ** 0.5 if len(each) > 1 else 0.0 for name, each in worse.items()}
    return next(name for name, each in worse.items() if each.mean() <= error[name])


def expected_from_parts(parts: Sequence[Sequence[Float[np.ndarray, " 4"]]]) -> Float[np.ndarray, "3 4"]:
    """Return `expected` from the RMSE of parts of each flight, which counts once because its parts are alike.

    With a single flight, another flight is assumed to differ from it as much as its parts differ from each other.
    """
    if len(parts) == 1:
        return expected(np.log(parts[0]), flights=1)
    return expected(np.log([rmse(np.stack(each)) for each in parts if len(each)]))


def rmse_by_flight(field: AbstractVectorField, logs: Sequence[FlightLog], steps: int) -> Float[np.ndarray, "f t 4"]:
    """Compute the RMSE in UNITS on each flight at the end of each interval."""
    return np.stack([rmse(errors_of(field, log, steps)) for log in logs])


def errors_of(field: AbstractVectorField, log: FlightLog, steps: int) -> Float[np.ndarray, "n t 4"]:
    """Compute the errors in UNITS for windows of a flight at the end of each interval."""
    return np.stack(flight_errors(field, windows_for(field, log, steps, steps)), axis=-1)


def windows_for(field: AbstractVectorField, log: FlightLog, steps: int, stride: int) -> Trajectories:
    """Cut a flight into windows like `cut_windows`, with the filters' states if the field has a past."""
    if not isinstance(field, DisturbanceModel):
        return cut_windows([log], steps, stride)
    parts = [(each, observe(field, each)[0]) for each in sequences([log], steps)]
    return concatenate(
        [windows_of(seen, np.asarray(each.u[0]), each.dt, steps=steps, stride=stride) for each, seen in parts]
    )


def rmse(errors: Float[np.ndarray, "n t 4"]) -> Float[np.ndarray, "t 4"]:
    return np.sqrt(np.mean(np.square(errors), axis=0))


def ratio(errors: Float[np.ndarray, "*n 4"], others: Float[np.ndarray, "*n 4"]) -> float:
    return float(np.exp(np.log(errors / others).mean()))
