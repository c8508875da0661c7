"""Fit a model to records in which only some states were measured.

Levenberg–Marquardt sums normal equations over segments (`shooting`), so memory does not grow with the record's length.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import in_double, ravel_learned
from hybrid_jax.dynamics.outputs import Measured, StateSpaceModel
from hybrid_jax.estimation import elimination, learned_numbers, record_search, shooting, uncertainty
from hybrid_jax.estimation.discretisation import FINE, Solver, warn_of_steps
from hybrid_jax.estimation.elimination import End, reduced
from hybrid_jax.estimation.normal_equations import inverse
from hybrid_jax.estimation.record_search import TINY, size_of
from hybrid_jax.estimation.shooting import Problem
from hybrid_jax.estimation.uncertainty import Interval
from hybrid_jax.implicit_solvers import solver_errors
from hybrid_jax.integrate import RK4
from hybrid_jax.records import Between, Record, completed, on_grid
from hybrid_jax.runtime import entry
from hybrid_jax.status import Status

VAGUE = np.log(100.0)  # a logarithm with a larger standard error is not identifiable
FASTEST = 2.0  # decay rate times RK4's step, which is unstable above 2.8
CONTINUOUS = 1e-6  # allowed gap between segments, over the size of a state, if the state has no process noise


class RecordFit(eqx.Module):
    """The result of `fit_records`.

    Attributes:
        model: the model with the fitted numbers, in double precision if JAX has it enabled, and the noise; it starts
            like the first record.
        starts: the state at the start of each record (r, d).
        starts_error: the standard error of `starts` (r, d); three rotation angles [rad] for an attitude.
        ends: the state at the end of each record (r, d).
        times: first and last time of each record at which outputs were compared [s] (r, 2).
        intervals: confidence interval of each number of the physics and the outputs, for example log_drag or gyro.bias.
            It is infinite if not identifiable, as for a logarithm (log_…) known no better than by a factor of 100.
        errors: RMS of each output's errors in the fit (k).
        set_aside: number of samples of each output that counted less, because their errors were too large.
        covariance: the covariance (p, p) of the learned numbers, in the order of `ravel_learned`.
        steps: number of Levenberg–Marquardt steps, summed over rounds.
        status: how the last round ended.
        discretisation: the largest change of a learned number by half the solver's step, in standard errors; 0 without
            learned numbers, infinite if a part of the model is faster than RK4's step.
        directions: initial states and combinations of learned numbers that no sample determines.
    """

    model: StateSpaceModel
    starts: Float[np.ndarray, "r d"]
    starts_error: Float[np.ndarray, "r e"]
    ends: Float[np.ndarray, "r d"]
    times: Float[np.ndarray, "r 2"]
    intervals: dict[str, Interval]
    errors: dict[str, Float[np.ndarray, " k"]]
    set_aside: dict[str, int]
    covariance: Float[np.ndarray, "p p"]
    steps: int
    status: Status
    discretisation: float
    directions: tuple[str, ...] = ()

    @property
    def undetermined(self) -> tuple[str, ...]:
        """The physical parameters that are not identifiable from the records."""
        return tuple(name for name, each in self.intervals.items() if not np.isfinite(float(each.high - each.low)))


@entry
def fit_records(
    model: StateSpaceModel,
    records: Sequence[Record],
    *,
    dt: float,
    between: Between = "held",
    segment: float | None = None,
    prior: Mapping[str, float] | None = None,
    robust: float = np.inf,
    rounds: int = 2,
    max_steps: int = 50,
    starts: int = 1,
    solver: Solver = None,
    substeps: int = 1,
    level: float = 0.95,
) -> RecordFit:
    """Fit the learned numbers of a model and the initial states to all measured outputs.

    You get a warning if the fit did not converge, if half the solver's step gives different numbers (`discretisation`),
    and if no sample determines some of the numbers (`directions`).

    Args:
        model: the initial model. Outputs count relative to their `noise`. If it is not given, this is the standard
            deviation of the samples in the first round, relative to which `prior` is weighted.
        records: one or more records. Each output is compared at its own samples in each record.
        dt: length of the intervals in which the inputs are constant [s].
        between: how inputs act between their samples: "held", "linear" or "averaged", see `records.on_grid`.
        segment: length of the segments of multiple shooting [s], which come before whole simulations; by default there
            are none. You need them for unstable systems, a poor initial model, and process noise.
        prior: standard deviations of learned numbers from their start, by the beginning of their names in `intervals`,
            for example {"log_drag": 0.5, "residual": 0.3}; 0 keeps them, and the others are free.
        robust: errors beyond this many times their usual size count linearly, for example 3 for data with outliers. In
            the first round, that size is the noise, or a tenth of its default. By default all errors are squared.
        rounds: number of fits; outputs without known noise are weighted by their errors in the previous round.
        max_steps: maximum number of Levenberg–Marquardt steps in each round.
        starts: number of searches in the first round, of which the best continues. The first begins at the model, and
            the others at numbers drawn from `prior`; numbers without a prior are not drawn.
        solver: a solver of diffrax, by default `RK4`.
        substeps: number of solver steps in each interval.
        level: confidence level of the intervals, between 0 and 1.

    Raises:
        ValueError: if a record lacks an input or all outputs, no record has an output, there are too many unknowns, or
            an implicit solver finds no step.
    """
    records = checks.list_of("records", records, Record)
    checks.positive("dt", dt, "a positive number of seconds")
    if not robust > 0:
        raise ValueError(f"robust must be a positive number, got {checks.short_repr(robust)}")
    for name, number in (("rounds", rounds), ("max_steps", max_steps), ("starts", starts), ("substeps", substeps)):
        checks.count(name, number)
    if any(model.process) and segment is None:
        raise ValueError("segment must be given with process noise: it acts between segments")
    given, seen = model, {name for each in records for name, signal in each.signals.items() if len(signal)}
    kept = [name for name, h in model.outputs.items() if name in seen or not isinstance(h, Measured)]
    model = model.only(kept or model.outputs)
    records = completed(records, tuple(model.outputs), model.angles)
    gridded = [on_grid(each, model.inputs, tuple(model.outputs), dt, between) for each in records]
    record_search.check_signals(model, records, gridded, dt)
    # A step too far may overflow, and is taken back.
    with jax.enable_x64(True), solver_errors(solver), np.errstate(over="ignore", invalid="ignore"):
        model = in_double(model)
        record_search.check_rates(model, records)
        y = {name: np.concatenate([each.y[name] for each in gridded]) for name in gridded[0].y}
        for name in (name for name, each in y.items() if not len(each)):
            raise ValueError(f"records: no record has a sample of {name}")
        widest = {name: 1.0 if name in model.angles else np.inf for name in y}  # [rad]: whole turns do not matter
        deviation = {name: np.clip(_variation(model, name, each), TINY, widest[name]) for name, each in y.items()}
        for name, sizes in model.noise.items():
            if len(sizes) not in (1, len(deviation[name])):
                raise ValueError(f"noise of {name} must be one number or {len(deviation[name])}, got {len(sizes)}")
        known = {name: jnp.broadcast_to(jnp.array(sizes), deviation[name].shape) for name, sizes in model.noise.items()}
        scale = {name: jnp.asarray(each) for name, each in deviation.items()} | known
        # Plain least squares in the first round would follow outliers to another minimum.
        cautious = robust if known.keys() == scale.keys() else robust / 10
        problem = Problem(model, scale, cautious, dt, RK4() if solver is None else solver, substeps)
        steps = record_search.steps_of(segment, gridded, dt)
        theta, near = np.asarray(ravel_learned(model)[0], float), learned_numbers.deviations_of(model, prior or {})
        if len(theta) > record_search.MOST:
            remedy = "wrap the network in Frozen, or train it by fit on windows of estimate_windows"
            raise ValueError(f"model: {len(theta)} learned numbers are too many; {remedy}")
        segments = shooting.cut(gridded, steps)
        nodes = len(gridded), 1 if segment is None else segments.valid.shape[1], 1
        centres, spread = jnp.tile(jnp.array(model.start), nodes), np.array(model.spread)[None]
        most = learned_numbers.largest_steps(model)
        search = record_search.Search(problem, centres, near, theta, segments, spread, most=most)
        (search, theta, own), total = record_search.approached(search, segment), 0
        if any(model.process):
            walked = np.array(model.process) * np.sqrt(steps * dt)
            search = search._replace(off=np.maximum(walked, CONTINUOUS * record_search.sizes_of(search, theta, own)))
        else:
            own = own[:, : model.space.tangent_size]
            search = search._replace(centres=search.centres[:, :1], off=None)
        drawn = np.random.default_rng(0).normal(size=(starts, len(theta))) * np.where(np.isfinite(near), near, 0.0)
        drawn[0] = 0.0
        for i in range(rounds):
            moves = drawn if i == 0 else drawn[:1]
            ends = [search.descend(theta + move, own, max_steps=max_steps) for move in moves]
            end = min(ends, key=lambda each: np.nan_to_num(float(jnp.sum(each.equations.square)), nan=np.inf))
            theta, own, total = end.theta, end.own, total + end.steps
            errors = search.errors(theta, own)
            if i < rounds - 1:
                search = search.weighted(errors, robust, known)
        found = _result(search, end._replace(steps=total), records, gridded, errors, robust, level)
        sizes = {k: v.tolist() for k, v in search.weighted(errors, robust, known).problem.scale.items()}
        own = {"outputs": {**given.outputs, **found.model.outputs}, "angles": given.angles}
        fitted = dataclasses.replace(found.model, noise={**given.noise, **sizes}, **own)
    found = dataclasses.replace(found, model=in_double(fitted))
    warn_of_steps(found.discretisation, f"a smaller dt, or substeps={2 * substeps}")
    if found.status != Status.OK:
        checks.warn(f"records: the fit {found.status.message}; check all units and the model")
    for name, each in found.errors.items():
        if (each > 1.1 * deviation[name] + FINE * min(np.abs(y[name]).max(), widest[name])).any():
            far = "is off by more than a radian", "varies less than the fit's errors"
            line = f"{name} {far[int((deviation[name] < widest[name]).all())]}: check all units and the model"
            checks.warn(f"records: {line}, or give a segment")
    if found.directions:
        checks.warn(f"records: no sample determines {'; '.join(found.directions)}")
    return found


def _variation(model: StateSpaceModel, name: str, y: Float[Array | np.ndarray, "n k"]) -> Float[np.ndarray, " e"]:
    """Return the standard deviation of an output's samples, compared as its errors are."""
    if not isinstance(model.outputs[name], Measured):
        return np.std(np.asarray(y), axis=0)
    return np.std(jax.vmap(lambda each: model.error(name, each, jnp.asarray(y[0])))(jnp.asarray(y)), axis=0)


def _result(search: record_search.Search, end: End, records, gridded, errors, robust, level: float) -> RecordFit:
    model, start = search.model(end.theta), np.asarray(search.nodes(end.own)[0])[:, 0]
    covariance, variances = _covariance(search, end, errors)
    names = learned_numbers.learned_names(model)
    # The others keep what they share with it: it may be anything from zero to where it begins to matter.
    variance = np.diagonal(covariance)
    lost = learned_numbers.logarithms(names) & np.isfinite(variance) & (variance > VAGUE**2)
    covariance = np.where(lost | lost[:, None], np.diag(np.where(lost, np.inf, 0.0)), covariance)
    deviation = np.sqrt(variances[:, : model.space.tangent_size])
    found = intervals_of(model, covariance, level)
    limits = {name: robust * size_of(each, robust) for name, each in errors.items()}
    aside = {name: int((np.abs(each) > limits[name]).any(axis=1).sum()) for name, each in errors.items()}
    rms = {name: np.sqrt(np.mean(each**2, axis=0)) for name, each in errors.items()}
    model = dataclasses.replace(model, start=start[0])
    ends = np.asarray(search.predicted(end.theta, end.own).states)[:, -1, -1]
    times = np.array([(each.start, each.start + len(each.u) * search.problem.dt) for each in gridded])
    moved = _discretisation(search, end, errors)
    fit = RecordFit(model, start, deviation, ends, times, found, rms, aside, covariance, end.steps, end.status, moved)
    vague = (name for name, each in zip(names, lost, strict=True) if each)
    return dataclasses.replace(fit, directions=(*vague, *record_search.directions(search, end, records)))


def intervals_of(model: StateSpaceModel, covariance: Float[np.ndarray, "p p"], level: float) -> dict[str, Interval]:
    """Return the interval of each number of the physics and of the outputs; `covariance` is of all learned numbers."""
    found, rows = {}, learned_numbers.places_of(model, learned_numbers.physics_in)
    if len(rows):
        found = uncertainty.intervals(model.field, jnp.asarray(covariance[np.ix_(rows, rows)]), level)
    theta, names = np.asarray(ravel_learned(model)[0]), learned_numbers.learned_names(model)
    away = scipy.special.ndtri((1 + level) / 2) * np.sqrt(np.diagonal(covariance))
    for i in learned_numbers.places_of(model, lambda model: model.outputs):
        found[names[i]] = Interval(theta[i], theta[i] - away[i], theta[i] + away[i])
    return jax.tree.map(np.asarray, found)


def _discretisation(search: record_search.Search, end: End, errors) -> float:
    """Return the Gauss–Newton step with half the solver's step, in standard errors of white noise."""
    if not (p := len(search.theta)):
        return 0.0
    problem, segments = search.problem, search.segments
    halved = search._replace(problem=dataclasses.replace(problem, substeps=2 * problem.substeps))
    found, fine = (each.predicted(end.theta, end.own) for each in (search, halved))
    if isinstance(problem.solver, RK4):
        slopes = jax.vmap(jax.jacfwd(search.model(end.theta).field))
        at = (jnp.concatenate(jnp.asarray(each)[:, :, 0]) for each in (found.states, segments.u))
        rates = np.nan_to_num(np.asarray(slopes(*at)))
        if np.abs(np.linalg.eigvals(rates)).max() * problem.dt / problem.substeps > FASTEST:
            return np.inf  # the search stops where the solver becomes unstable, and half the step changes nothing
    now, fine = found.y, fine.y
    size = {name: FINE * _variation(problem.model, name, segments.y[name][segments.there[name]]) for name in now}
    size = {name: jnp.asarray(each + size_of(errors[name], problem.robust)) for name, each in size.items()}
    # Shifted samples give the same errors as half the step, without compiling again.
    moved = segments._replace(y={name: each - (fine[name] - now[name]) for name, each in segments.y.items()})
    search = search._replace(problem=dataclasses.replace(problem, scale=size))
    both = (search._replace(segments=each).equations(end.theta, end.own) for each in (segments, moved))
    sums = [reduced(each, p).equations for each in both]
    found = inverse(jnp.sum(sums[0].gram, axis=0))
    step = found.matrix @ jnp.sum(sums[1].score - sums[0].score, axis=0)
    error = jnp.sqrt(jnp.diagonal(found.matrix))
    return float(jnp.max(jnp.where(found.identified, jnp.abs(step) / jnp.where(error > 0, error, 1), 0.0)))


def _covariance(search: record_search.Search, end: End, errors):
    """Return the covariance of θ (p, p) and the variances of the nodes (r, s); infinite where no output changes.

    In a simulation, model errors persist, so each piece's score is one observation (a sandwich; White 1980). For few
    samples this is too small, so it is at least the covariance for independent errors (Angrist and Pischke, Mostly
    Harmless Econometrics, 2009, 8.2). With process noise, errors are independent.
    """
    independent, own = elimination.covariance(end.equations, len(end.theta))
    if search.off is not None:
        return independent, own
    gram, score, _ = search.local(end.theta, end.own).equations
    meat = np.asarray(end.equations.gram + jnp.einsum("rsp,rsq->rpq", score, score) - jnp.sum(gram, axis=1))
    found, starts = elimination.covariance(end.equations, len(end.theta), meat)  # priors count as usual
    problem, most = search.problem, search.problem.robust
    r = np.concatenate([np.clip(e / problem.scale[k], -most, most).ravel() for k, e in errors.items()])
    spare = len(r) - len(end.theta) - len(end.own) * np.count_nonzero(problem.model.spread)
    share = float(r @ r) / max(spare, 1)
    with np.errstate(invalid="ignore", divide="ignore"):  # infinite if not identifiable, zero if known
        ratio = np.nan_to_num(np.diagonal(independent) * share / np.diagonal(found), posinf=1.0)
        more = np.sqrt(np.maximum(ratio, 1.0))
        return found * more * more[:, None], np.fmax(starts, own * share)
