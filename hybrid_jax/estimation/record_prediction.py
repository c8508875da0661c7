"""Simulate a model with the inputs of a record, and predict from its last samples."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import in_double
from hybrid_jax.dynamics.composition import Frozen
from hybrid_jax.dynamics.outputs import StateSpaceModel
from hybrid_jax.estimation import record_search, shooting
from hybrid_jax.estimation.discretisation import Solver
from hybrid_jax.estimation.record_fit import RecordFit, fit_records
from hybrid_jax.estimation.shooting import Problem
from hybrid_jax.integrate import RK4
from hybrid_jax.records import GAP, Between, Record, Signal, on_grid
from hybrid_jax.runtime import entry


@entry
def simulate(
    model: StateSpaceModel,
    record: Record,
    start: Float[np.ndarray, " d"] | None = None,
    *,
    dt: float,
    begin: float | None = None,
    between: Between = "held",
    solver: Solver = None,
    substeps: int = 1,
) -> tuple[dict[str, Float[np.ndarray, "n k"]], Float[np.ndarray, "t d"]]:
    """Return the outputs at the times of a record's samples, and the states at the edges of all intervals.

    Args:
        model: the model to simulate.
        record: the inputs, and the times of the outputs' samples; the values of outputs are not read.
        start: the state at the first time (d,), by default the model's start.
        dt: length of the intervals in which inputs are constant [s].
        begin: the first time [s], by default at the first sample of an output.
        between: how inputs act between samples.
        solver: a solver of diffrax, by default `RK4`.
        substeps: number of solver steps in each interval.

    Raises:
        ValueError: if the record lacks an input or all outputs.
    """
    model = _measured_in(record, model)
    gridded = [on_grid(record, model.inputs, tuple(model.outputs), dt, between, begin)]
    with jax.enable_x64(True):
        model = in_double(model)
        problem = Problem(model, {}, np.inf, dt, RK4() if solver is None else solver, substeps)
        segments = shooting.cut(gridded, len(gridded[0].u))
        x0 = jnp.asarray(model.start if start is None else start, float)[None]
        y, _, states = shooting.simulated(problem, model, x0, segments)
        found = {name: np.asarray(each)[0, 0][segments.there[name][0, 0]] for name, each in y.items()}
        return found, np.asarray(states[0, 0])


@entry
def predict(
    model: StateSpaceModel, past: Record, future: Record, *, dt: float, between: Between = "held", **options: Any
) -> dict[str, Float[np.ndarray, "n k"]]:
    """Return the outputs at the times of a record's samples, starting where the previous record ends.

    The past states and their disturbances are estimated by `fit_records` with fixed learned numbers. You get a warning
    if the past is too short for this.

    Args:
        model: a model with known numbers and noise; its start is the expected state at the first time of the past.
        past: the last samples; it should be longer if more states are hidden.
        future: the inputs from the end of the past on, and the times of the outputs' samples to predict; the values of
            outputs are not read.
        dt: length of the intervals in which inputs are constant [s].
        between: how inputs act between samples.
        options: other arguments of `fit_records`, such as robust, segment, solver and substeps.

    Raises:
        ValueError: if a record lacks an input or all outputs, or inputs begin long after the past.
    """
    joined = dict(future.signals)
    for name in (each for each in model.inputs if past.signals.get(each) and joined.get(each)):  # with samples
        before, after = past.signals[name], joined[name]
        if after.t[0] > before.t[-1] + GAP * before.interval:
            ends = f"begins at {after.t[0]:.6g} s, and the past ends at {before.t[-1]:.6g} s"
            raise ValueError(f"{future.name}: {name} {ends}")
        earlier = before.t < after.t[0]
        t, values = np.append(before.t[earlier], after.t), np.concatenate([before.values[earlier], after.values])
        joined[name] = Signal(t, values, after.axes, after.source)
    still = eqx.tree_at(lambda model: model.field, model, Frozen(model.field))
    still = _measured_in(past, still)
    if np.isinf(model.spread).any():  # a search from the model's start may end in a local minimum
        lengths = (np.ptp(past.signals[name].t) for name in still.outputs if past.signals.get(name))
        steps = max(round(max(lengths, default=0.0) / 10 / dt), 1)
        options = {"segment": dt * shooting.rounded_up(steps, fine=8)} | options
    known = fit_records(still, [past], dt=dt, between=between, rounds=1, **options)
    kept = {name: value for name, value in options.items() if name in ("solver", "substeps")}
    options = {"begin": known.times[0, 1], "dt": dt, "between": between} | kept
    y, states = simulate(model, Record(future.name, joined), known.ends[0], **options)
    _warn_if_short(model, past, known, states)
    return y


def _measured_in(record: Record, model: StateSpaceModel) -> StateSpaceModel:
    return model.only([name for name in model.outputs if record.signals.get(name)] or model.outputs)


def _warn_if_short(model: StateSpaceModel, past: Record, known: RecordFit, states: Float[np.ndarray, "t d"]) -> None:
    """Warn of states that are less certain after the past than they change in the prediction."""
    free, space = np.array(model.spread) > 0, model.space
    count = sum(past.signals[name].values.size for name in known.errors)
    spare = np.inf if any(model.process) else max(count - free.sum(), 0) / count  # with noise, the error is known
    change = record_search.sizes_between(space, states, known.starts[0])
    error = np.divide(known.starts_error[0], np.sqrt(spare), out=np.full(len(free), np.inf), where=spare > 0)
    if lost := [name for name, each in zip(space.tangent_names, free & (error > change), strict=True) if each]:
        checks.warn(f"{past.name}: too short to determine {', '.join(lost)}: the prediction is a guess")
