"""Make windows of records in which only some states were measured, to train or adapt networks."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import in_double, ravel_learned
from hybrid_jax.dynamics.composition import Frozen
from hybrid_jax.dynamics.outputs import Measured, StateSpaceModel
from hybrid_jax.estimation import shooting
from hybrid_jax.estimation.discretisation import Solver
from hybrid_jax.estimation.elimination import End, undetermined
from hybrid_jax.estimation.record_search import Search
from hybrid_jax.estimation.shooting import Problem
from hybrid_jax.implicit_solvers import solver_errors
from hybrid_jax.integrate import RK4
from hybrid_jax.records import Between, Gridded, Record, completed, on_grid
from hybrid_jax.runtime import entry
from hybrid_jax.status import Status
from hybrid_jax.trajectories import Trajectories

NEAR = 0.25, 0.5, 1.0  # shares of a piece whose samples count, one after the other
ROUNDING = 1e-6  # of a sample's time, in intervals


@entry
def estimate_windows(
    model: StateSpaceModel,
    records: Sequence[Record],
    *,
    dt: float,
    steps: int,
    around: float,
    between: Between = "held",
    robust: float = np.inf,
    solver: Solver = None,
    substeps: int = 1,
) -> Trajectories:
    """Return windows for `fit` and `adapt`, whose initial states are estimated from the samples around them.

    The model predicts the samples from `around` seconds before to `around` seconds after the start of a window, by
    least squares. If the model has a constant error, its effects before and after the start nearly cancel. The model
    also moves each sample to the nearest edge of an interval. States that were not measured are NaN in x.

    Args:
        model: the model with known numbers, and the noise of every output, for example that of `fit_records`. Its
            outputs should be the states themselves, as they are by default.
        records: one or more records. Windows in a gap, whose initial state no sample determines, are left out.
        dt: length of the intervals [s].
        steps: number of intervals in each window. Windows follow each other.
        around: time before and after the start of a window in which samples count [s]. With a longer one, noise
            matters less, and errors of the model more.
        between: how inputs act between their samples: "held", "linear" or "averaged", see `records.on_grid`.
        robust: errors beyond this many times the noise count linearly.
        solver: a solver of diffrax, by default `RK4`.
        substeps: number of solver steps in each interval.

    Raises:
        ValueError: if an output is not a state or has no noise, a record lacks an input or all outputs, all records
            are too short, no sample determines an initial state, or an argument is out of range.
    """
    records = checks.list_of("records", records, Record)
    checks.instance("model", model, StateSpaceModel)
    checks.count("steps", steps)
    for name, seconds in (("dt", dt), ("around", around)):
        checks.positive(name, seconds, "a positive number of seconds")
    if around < dt:
        raise ValueError(f"around must be at least dt = {dt:.3g} s, got {checks.short_repr(around)}")
    model, half = _with_states(model, records), round(around / dt)
    records = completed(records, tuple(model.outputs), model.angles)
    gridded = [on_grid(each, model.inputs, tuple(model.outputs), dt, between) for each in records]
    after = max(steps, half)
    places = [(each, i) for each in gridded for i in range(half, len(each.u) - after + 1, steps)]
    if not places:
        raise ValueError(f"records: all are shorter than {(half + after) * dt:.3g} s; lower `steps` or `around`")
    dtype = jnp.zeros(()).dtype
    with jax.enable_x64(True), solver_errors(solver), np.errstate(over="ignore", invalid="ignore"):
        model = in_double(eqx.tree_at(lambda model: model.field, model, Frozen(model.field)))
        scale = {name: jnp.array(sizes) for name, sizes in model.noise.items()}
        problem = Problem(model, scale, robust, dt, RK4() if solver is None else solver, substeps)
        near = [_part(each, i - half, 2 * half) for each, i in places]
        end, states = _estimated(problem, np.stack([_guess(model, each) for each in near]), near)
        windows = [_part(each, i, steps) for each, i in places]
        x = _measured(problem, states[:, half], windows)
    if end.status != Status.OK:
        checks.warn(f"records: the search for initial states {end.status.message}; check all units and the model")
    kept = _determined(model, end) & ~np.isnan(x).all(axis=(1, 2))
    u = np.stack([each.u for each in windows])
    return Trajectories(*(part[kept].astype(dtype) for part in (states[:, half], u, x)), dt=dt)


def _with_states(model: StateSpaceModel, records: Sequence[Record]) -> StateSpaceModel:
    """Return the model with the measured outputs only, which must be states."""
    seen = {name for each in records for name, signal in each.signals.items() if len(signal)}
    model = model.only([name for name in model.outputs if name in seen] or model.outputs)
    for name, h in model.outputs.items():
        if not isinstance(h, Measured):
            raise ValueError(f"outputs: {name} is a function of the state, but windows have states; use fit_records")
        if name not in model.noise:
            raise ValueError(f"noise: {name} has none; the model that fit_records returns has it")
    return model


def _part(record: Gridded, first: int, steps: int) -> Gridded:
    """Return some intervals of a record, with the samples from their start to their end."""
    y, index, share = {}, {}, {}
    for name, values in record.y.items():
        at = record.index[name] + record.share[name] - first
        inside = (at > -ROUNDING) & (at < steps + ROUNDING)
        at = np.clip(at[inside], 0, steps)
        index[name] = np.minimum(at.astype(int), steps - 1)
        y[name], share[name] = values[inside], at - index[name]
    return Gridded(record.start, record.u[first : first + steps], y, index, share)


def _guess(model: StateSpaceModel, record: Gridded) -> Float[np.ndarray, " d"]:
    """Return the first measured states, and the model's start in place of others."""
    x = np.array(model.start)
    for name, values in record.y.items():
        if len(values):
            x[slice(*model.outputs[name].part)] = values[0]
    return x


def _estimated(problem: Problem, guess: Float[np.ndarray, "n d"], pieces: list[Gridded]):
    """Return the end of the search for the pieces' initial states, and the states along them (n, t + 1, d).

    At first only samples near the start count: from a poor guess, predictions of later ones are too far off.
    """
    search = _search(problem, guess, pieces)
    segments, own = search.segments, search.still
    for share in NEAR:
        last = share * len(pieces[0].u)
        near = {name: each & (segments.index[name] < last) for name, each in segments.there.items()}
        centres = search.nodes(own)[0]
        search = search._replace(centres=centres, segments=segments._replace(there=near))
        end = search.descend(search.theta, search.still)
        own = end.own
    return end, np.asarray(search.predicted(end.theta, end.own).states)[:, 0]


def _search(problem: Problem, centres: Float[np.ndarray, "n d"], pieces: list[Gridded]) -> Search:
    theta, free = np.asarray(ravel_learned(problem.model)[0]), np.full((1, problem.model.space.tangent_size), np.inf)
    segments = shooting.cut(pieces, len(pieces[0].u))
    return Search(problem, jnp.asarray(centres)[:, None], np.zeros(len(theta)), theta, segments, free)


def _measured(problem: Problem, x0: Float[np.ndarray, "n d"], pieces: list[Gridded]) -> Float[np.ndarray, "n t d"]:
    """Return the samples at the edges of intervals, NaN where there is none; the model moves them to the nearest."""
    search, outputs = _search(problem, x0, pieces), problem.model.outputs
    found, segments = search.predicted(search.theta, search.still), search.segments
    x = np.full((len(x0), len(pieces[0].u), x0.shape[1]), np.nan)
    for name, there in segments.there.items():
        at = segments.index[name] + (1.0 if segments.share is None else segments.share[name])
        window, segment, sample = np.nonzero(there & (at >= 0.5))
        edge, part = np.round(at[window, segment, sample]).astype(int), slice(*outputs[name].part)
        at_edge, errors = found.states[window, segment, edge, part], found.errors[name][window, segment, sample]
        x[window, edge - 1, part] = jax.vmap(outputs[name].quantity.retract)(at_edge, -errors)
    return x


def _determined(model: StateSpaceModel, end: End) -> Bool[np.ndarray, " n"]:
    """Return which initial states are determined by samples; warn of others, and raise ValueError if there is none."""
    found = [undetermined(each, model.space.tangent_names) for each in np.asarray(end.equations.gram)]
    kept = np.array([not lines for lines in found])
    for line in [lines[0] for lines in found if lines][:1]:
        what = f"records: no sample determines {line} at the start of {(~kept).sum()} of {len(found)} windows"
        if not kept.any():
            raise ValueError(f"{what}; give a longer `around`")
        checks.warn(f"{what}, which are left out; a longer `around` may help")
    return kept
