"""`adapt_records`: adapt a model to records of a changed system of which not every state is measured."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Bool, Float

from hybrid_jax import checks
from hybrid_jax.adaptation.plausible import Plausible
from hybrid_jax.adaptation.results import lines_outside
from hybrid_jax.adaptation.selection import ENOUGH, surely
from hybrid_jax.dynamics.base import in_double, ravel_learned
from hybrid_jax.dynamics.outputs import StateSpaceModel
from hybrid_jax.estimation import learned_numbers, record_search, shooting
from hybrid_jax.estimation.discretisation import Solver
from hybrid_jax.estimation.record_fit import RecordFit, fit_records, intervals_of
from hybrid_jax.estimation.record_search import Search
from hybrid_jax.estimation.record_windows import measured_outputs
from hybrid_jax.estimation.shooting import Problem
from hybrid_jax.estimation.uncertainty import Interval
from hybrid_jax.integrate import RK4
from hybrid_jax.networks.standardise import motion_of
from hybrid_jax.records import Between, Record, completed, on_grid
from hybrid_jax.runtime import entry
from hybrid_jax.trajectories import features_of, shares_outside

PARTS = 7  # of all records, which are left out in turn; in shorter parts the fitted start hides more of a change
SOURCE = "source"  # the candidate that changes nothing


class RecordAdaptation(eqx.Module):
    """The result of `adapt_records`.

    Attributes:
        fit: the fit of the chosen candidate; it is the source itself if that was chosen.
        chosen: the numbers that changed: "source" (none), "sensors", "physics", "sensors and physics" or "all".
        changes: confidence interval of the change of each number that changed, by the names of `fit.intervals`.
        errors: error of each candidate on the parts that were left out, relative to that of the source.
        outside: share of samples, 0 to 1, outside the range in which `fit` trained the source's network, by quantity.
    """

    fit: RecordFit
    chosen: str
    changes: dict[str, Interval]
    errors: dict[str, float]
    outside: dict[str, float]

    @property
    def model(self) -> StateSpaceModel:
        """The adapted model."""
        return self.fit.model

    def report(self) -> str:
        """Return a summary in plain text, a few lines."""
        tried = ", ".join(f"{name} {error:.3g}" for name, error in self.errors.items())
        lines = [f"RMSE on left-out parts of the records, relative to the source's: {tried}."]
        lines += lines_outside(self.outside)
        if self.chosen == SOURCE:
            return "\n".join(["No change is confirmed, so all numbers stay as they are.", *lines])
        lines = [f"Changed: {self.chosen}, which surely predicts left-out parts better.", *lines]
        for name, change in self.changes.items():
            value, low, high = map(float, self.fit.intervals[name])
            moved = "change {:.3g} ({:.3g} to {:.3g})".format(*map(float, change))
            lines.append(f"  {name}  {value:.4g} ({low:.4g} to {high:.4g}), {moved}")
        return "\n".join([*lines, *["Kept as before: all other numbers."][: self.chosen != "all"]])


@entry
def adapt_records(
    source: RecordFit | StateSpaceModel,
    records: Sequence[Record],
    *,
    dt: float,
    between: Between = "held",
    robust: float = np.inf,
    plausible: Plausible = Plausible(),  # noqa: B008
    solver: Solver = None,
    substeps: int = 1,
    level: float = 0.95,
    **options: Any,
) -> RecordAdaptation:
    """Adapt a fitted model to records of the changed system, if parts that are left out confirm the change.

    The candidates are no change, the outputs' own numbers, the physics, both, and all with the residual. Each is fitted
    by `fit_records` with a prior around the source: a plausible change, plus the source's own uncertainty. Then a
    seventh of the records is left out in turn: the candidate is fitted to the other parts, and predicts this one, of
    which only the initial state is fitted. The result is the smallest candidate that predicts these parts surely better
    than the source (see `selection.surely`), and that no other one beats surely; else it is the source. Intervals are
    those of `fit_records`, or by the jackknife over the parts if they are wider.

    Args:
        source: the fit before the change, or a model with noise, for example one that `fit` trained on windows of
            `estimate_windows`; its numbers then count as known exactly. The noise is the size of the errors to expect.
            You should wrap a large network in `Frozen`: its weights stay as they are.
        records: one or more records of the changed system, in which each output has samples.
        dt: length of the intervals in which the inputs are constant [s].
        between: how inputs act between their samples.
        robust: errors beyond this many times their usual size count linearly.
        plausible: `relative` is the standard deviation of a change over the source's value, or of a logarithm.
        solver: a solver of diffrax, by default `RK4`.
        substeps: number of solver steps in each interval.
        level: confidence level of the intervals, between 0 and 1.
        options: other arguments of `fit_records`, for example segment and max_steps.

    Raises:
        ValueError: as `fit_records`, or if a model has no noise, or options have a prior or rounds, which the source
            determines.
    """
    if own := options.keys() & {"prior", "rounds"}:
        raise ValueError(f"{min(own)} cannot be given: it is determined by the source")
    records, grid = checks.list_of("records", records, Record), {"dt": dt, "between": between}
    grid |= {"robust": robust, "solver": solver, "substeps": substeps}
    if alone := isinstance(source, StateSpaceModel):
        start, variances = measured_outputs(source, records), 0.0
    else:
        checks.instance("source", source, RecordFit)
        start, variances = source.model, np.diagonal(source.covariance)
    with jax.enable_x64(True):
        model = in_double(start)
        names, theta = learned_numbers.learned_names(model), np.asarray(ravel_learned(model)[0])
        sizes = np.asarray(plausible.relative_to(names, theta))
        wide = np.sqrt(np.where(sizes > 0, sizes, np.inf) ** 2 + variances)
        near = {name: np.where(free, wide, 0.0) for name, free in _candidates(model, len(theta)).items()}
    fits, said = {}, {}
    for name, deviations in near.items():
        prior = dict(zip(names, deviations, strict=True))
        with warnings.catch_warnings(record=True) as said[name]:
            warnings.simplefilter("always")
            fits[name] = fit_records(start, records, prior=prior, rounds=1, **grid, **options)
    source = fits[SOURCE] if alone else source
    with jax.enable_x64(True), np.errstate(over="ignore", invalid="ignore"):
        left, without, paths = _left_out(model.only(source.errors), records, fits, near, **grid)
        chosen = _chosen(left)
        errors = {name: float(np.sqrt(np.sum(each) / np.sum(left[SOURCE]))) for name, each in left.items()}
        for each in said[chosen]:
            checks.warn(str(each.message))
        known = motion_of(model.field)
        outside = {} if known is None else shares_outside(features_of(known, model.space), paths[chosen])
        if chosen == SOURCE:
            return RecordAdaptation(source, SOURCE, {}, errors, outside)
        moves, more = near[chosen] > 0, _more(fits[chosen], without[chosen])
        return RecordAdaptation(*_changed(source, fits[chosen], chosen, moves, more, level), errors, outside)


def _candidates(model: StateSpaceModel, p: int) -> dict[str, Bool[np.ndarray, " p"]]:
    """Return which learned numbers each candidate fits, the fewest first; each fits others than those before."""
    sensors, physics = np.zeros((2, p), bool)
    sensors[learned_numbers.places_of(model, lambda model: model.outputs)] = True
    physics[learned_numbers.places_of(model, learned_numbers.physics_in)] = True
    both = {"sensors and physics": sensors | physics, "all": np.ones(p, bool)}
    found = {SOURCE: np.zeros(p, bool), "sensors": sensors, "physics": physics} | both
    first = {each.tobytes(): name for name, each in reversed(found.items())}
    return {name: each for name, each in found.items() if first[each.tobytes()] == name}


def _left_out(model, records, fits, near, *, dt, between, robust, solver, substeps):
    """Return each candidate's squared errors on each part with samples (k), and θ (k, p) fitted to the other parts.

    Also return the quantities along its whole prediction.
    """
    given = completed(records, tuple(model.outputs), model.angles)
    gridded = [on_grid(each, model.inputs, tuple(model.outputs), dt, between) for each in given]
    segments = shooting.cut(gridded, -(-max(len(each.u) for each in gridded) // -(-PARTS // len(gridded))))
    scale = {name: jnp.asarray(size) for name, size in model.noise.items()}
    problem = Problem(model, scale, robust, dt, RK4() if solver is None else solver, substeps)
    theta, spread = np.asarray(ravel_learned(model)[0]), np.array(model.spread)[None]
    most = learned_numbers.largest_steps(model)
    found, without, paths, sizes = {}, {}, {}, None
    for name, fit in fits.items():
        search = Search(problem, jnp.asarray(fit.starts)[:, None], near[name], theta, segments, spread, most=most)
        sizes = record_search.sizes_of(search, theta, search.still) if sizes is None else sizes
        parts = np.argwhere(np.any([each.any(axis=2) for each in segments.there.values()], axis=0))
        last = jnp.asarray(ravel_learned(fit.model)[0])
        states = search.predicted(last, search.still).states
        pairs = [_without(search, last, states[i, j, 0], sizes, i, j) for i, j in parts]
        found[name], without[name] = (np.array(each) for each in zip(*pairs, strict=True))
        x, u = (np.asarray(each)[segments.valid] for each in (states[:, :, 1:], segments.u))
        paths[name] = model.space.features(x, u)
    return found, without, paths


def _without(search: Search, theta, x, sizes: Float[np.ndarray, " e"], i: int, j: int):
    """Return the squared errors of part j of record i, from about x (d), and θ (p) fitted to the other parts."""
    there = {name: each.copy() for name, each in search.segments.there.items()}
    for each in there.values():
        each[i, j] = False
    if (search.deviations > 0).any():
        theta = search._replace(segments=search.segments._replace(there=there)).descend(theta, search.still).theta
    part = jax.tree.map(lambda leaf: leaf[i : i + 1, j : j + 1], search.segments)
    # Only the state at its start is fitted.
    alone = search._replace(centres=x[None, None], segments=part, spread=sizes[None], deviations=0 * theta + np.inf)
    end = alone.descend(theta, alone.still, free=np.zeros(len(theta), bool))
    return float(jnp.sum(end.equations.square)), np.asarray(theta)


def _more(fit: RecordFit, without: Float[np.ndarray, "k p"]) -> Float[np.ndarray, " p"]:
    """Return how many times larger each standard error is by the jackknife over parts (Efron 1982), at least 1.

    If physics lacks something, numbers make up for it, and differ from part to part more than noise explains.
    """
    k = len(without)
    error = (k - 1) / k**0.5 * without.std(axis=0, ddof=1)
    error *= scipy.special.stdtrit(k - 1, 0.975) / scipy.special.ndtri(0.975)  # few parts
    with np.errstate(invalid="ignore", divide="ignore"):  # infinite if not identifiable, zero if kept
        return np.fmax(np.nan_to_num(error / np.sqrt(np.diagonal(fit.covariance)), posinf=1.0), 1.0)


def _changed(source: RecordFit, fit: RecordFit, chosen: str, moves: Bool[np.ndarray, " p"], more, level: float):
    """Return the fit with the source's covariance of what did not change, the candidate, and intervals of changes.

    The source has the same physics, so its errors count as `more` times larger, too.
    """
    found = fit.covariance * more * more[:, None]
    covariance = np.where(moves | moves[:, None], found, source.covariance)
    both = found + source.covariance * more * more[:, None]
    cases = (fit.model, covariance), (fit.model, both), (source.model, source.covariance)
    with jax.enable_x64(True):
        values, apart, before = (intervals_of(in_double(model), own, level) for model, own in cases)
    names = learned_numbers.learned_names(fit.model)
    moved = [name for name, move in zip(names, moves, strict=True) if move and name in values]
    changes = {name: Interval(*(end - before[name].value for end in apart[name])) for name in moved}
    return eqx.tree_at(lambda fit: (fit.covariance, fit.intervals), fit, (covariance, values)), chosen, changes


def _chosen(left: Mapping[str, Float[np.ndarray, " k"]]) -> str:
    """Return the first candidate that surely predicts left-out parts better than the source, and that none beats."""
    if len(left[SOURCE]) < ENOUGH:
        return SOURCE
    beats = {(a, b): bool(surely(left[b], left[a])) for a in left for b in left if a != b}
    better = (a for a in left if beats.get((a, SOURCE)) and not any(beats[b, a] for b in left if b != a))
    return next(better, SOURCE)
