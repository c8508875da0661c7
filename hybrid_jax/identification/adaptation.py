"""Adapt a learned vehicle to flights after a change, and estimate the errors of its predictions with their past."""

import itertools
from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from functools import partial

import equinox as eqx
import numpy as np
from jaxtyping import Float

from hybrid_jax.adaptation import Adaptation, Auto, adapt, selection
from hybrid_jax.adaptation.expectation import Expected
from hybrid_jax.dynamics import AbstractVectorField, DisturbanceModel
from hybrid_jax.estimation import fit_disturbance, observe
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.windows import cut_each, flight_errors, sequences
from hybrid_jax.identification.learning import (
    NAMES,
    STEPS,
    expected_from_parts,
    first_intervals,
    rmse,
    with_past,
    without_past,
)
from hybrid_jax.trajectories import Trajectories, windows_of

ADAPTED = 600  # windows at most
HORIZONS = STEPS, 5 * STEPS  # intervals after which predictions with a past are compared
STRETCHES = 5  # of flights after a change, which are left out in turn

Errors = dict[int, Float[np.ndarray, " 4"]]  # RMSE of each quantity after a number of intervals


def adapted(
    field: AbstractVectorField, logs: Sequence[FlightLog], learned_from: Trajectories | None, most: int = ADAPTED
) -> tuple[AbstractVectorField, Adaptation]:
    """Adapt a model's physics, and its past if it has one, to at most `most` windows of flights after a change.

    If the model has a past, and predictions with it become surely worse by the change, only the past is adapted.

    Args:
        field: the source model.
        logs: flights after the change.
        learned_from: windows that the source was trained on, see `hybrid_jax.adapt`.
        most: the maximum number of windows to adapt to.

    Returns:
        The adapted model, and the adaptation of the model without its past, but with the expected errors of the model
        with it.
    """
    windows = cut_each(logs, STEPS, STEPS, most)
    adapt_by = partial(adapt, without_past(field), windows, learned_from=learned_from)
    found = adapt_by(method=Auto(networks=False))
    moved = eqx.tree_at(without_past, field, found.field)
    if not (isinstance(moved, DisturbanceModel) and isinstance(field, DisturbanceModel)):
        return moved, found
    horizons = {name: _steps(name, logs) for name in found.expected}
    asked = {*HORIZONS, *horizons.values()}, most * STEPS
    errors = _errors_with_past(moved, logs, *asked)
    if not eqx.tree_equal(moved, field) and _surely_larger(errors, before := _errors_with_past(field, logs, *asked)):
        found = adapt_by(method=Auto(parameters=False, networks=False))
        moved, errors = field, before
    return with_past(moved, logs, most * STEPS), replace(found, expected=_expected_of(errors, horizons))


def expected_with_past(
    model: DisturbanceModel, logs: Sequence[FlightLog], horizons: Sequence[str], most: int | None = None
) -> Expected:
    """Return the expected errors of a model whose past is learned from logs, by leaving out stretches in turn.

    A stretch is a flight, or a part of one that is longer than the past's memory. It is predicted by a past that is
    learned from the other stretches and has observed the samples before it.

    Args:
        model: the model with the past that it had before these logs.
        logs: flights after a change.
        horizons: as in `Adaptation.expected`, for example "0.1 s".
        most: the maximum number of intervals to learn from.
    """
    steps = {horizon: _steps(horizon, logs) for horizon in horizons}
    return _expected_of(_errors_with_past(model, logs, {*steps.values()}, most), steps)


def _steps(horizon: str, logs: Sequence[FlightLog]) -> int:
    return round(float(horizon.split()[0]) / logs[0].dt)


def _errors_with_past(
    model: DisturbanceModel, logs: Sequence[FlightLog], horizons: Set[int], most: int | None
) -> list[list[Errors]]:
    """Return the errors on each stretch of each flight, see `expected_with_past`."""
    flights = sequences(logs, 2 * STEPS)
    found: list[list[Errors]] = [[] for _ in flights]
    for i, one in enumerate(flights):
        x, u = np.concatenate([one.x0, one.x[0]]), np.asarray(one.u[0])
        count = max(1, min(-(-STRETCHES // len(flights)), int(one.horizon * one.dt / (2 * max(model.time_constants)))))
        for begin, end in itertools.pairwise(np.linspace(0, one.horizon, count + 1).astype(int)):
            rest = [(a, b) for a, b in ((0, begin), (end, one.horizon)) if b - a > 2 * STEPS]
            own = [windows_of(x[a : b + 1], u[a:b], one.dt, steps=b - a) for a, b in rest]
            others = first_intervals([*flights[:i], *own, *flights[i + 1 :]], most)
            past = fit_disturbance(model, others, steps=STEPS) if others else model
            seen = observe(past, one)[0, begin : end + 1]
            errors = {}
            for steps in (each for each in horizons if each <= end - begin):
                windows = windows_of(seen, u[begin:end], one.dt, steps=steps)
                errors[steps] = rmse(np.stack(flight_errors(past, windows), axis=-1))[-1]
            found[i].append(errors)
    return found


def _expected_of(errors: list[list[Errors]], horizons: Mapping[str, int]) -> Expected:
    found = {}
    for name, steps in horizons.items():
        if any(of_flights := [[one[steps] for one in flight if steps in one] for flight in errors]):
            found[name] = dict(zip(NAMES, map(tuple, expected_from_parts(of_flights).T.tolist()), strict=True))
    return found


def _surely_larger(errors: list[list[Errors]], others: list[list[Errors]]) -> bool:
    """Return whether errors of stretches are surely larger, by the mean of their logarithms over `HORIZONS`."""
    pair = ([one for flight in each for one in flight if one] for each in (errors, others))
    sizes = [[np.exp(2 * np.mean(np.log([one[k] for k in HORIZONS if k in one]))) for one in each] for each in pair]
    return len(sizes[0]) >= selection.ENOUGH and bool(selection.surely(*map(np.array, sizes)))
