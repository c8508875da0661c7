"""The search for the parameters and the states at the nodes of records, see `record_fit`."""

import dataclasses
import itertools
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import ravel_learned
from hybrid_jax.dynamics.window_checks import foreign_units, turns
from hybrid_jax.estimation import shooting
from hybrid_jax.estimation.elimination import End, descend, reduced, undetermined
from hybrid_jax.estimation.learned_numbers import learned_names
from hybrid_jax.estimation.normal_equations import NormalEquations
from hybrid_jax.estimation.shooting import Local, Model, Predicted, Problem, Segments
from hybrid_jax.records import Gridded, Record, Signal, integral
from hybrid_jax.state_space import StateSpace

APPROACH = (1.0, 0.1, 0.01)  # allowed gap between segments, over the size of a state, in turn
MOST = 3000  # unknowns
CLUSTERS = 20  # of a simulation's errors, each of which is one observation
GAP = 5.0  # sample intervals without a sample that count as a gap
TINY, SMALL = 1e-12, 1e-3
SLOW = 300  # dt in one interval, or records in one input: more is a mistake in a unit of time


class Sums(NamedTuple):
    """`NormalEquations` to which errors are added."""

    gram: Float[np.ndarray, "r q q"]
    score: Float[np.ndarray, "r q"]
    cost: Float[np.ndarray, " r"]

    def add(self, rows, jacobian, errors, deviations) -> None:
        """Add errors with known standard deviations; errors with an infinite one do not count."""
        weight = 1 / np.maximum(deviations, TINY)
        jacobian, errors = jacobian * weight[..., None], errors * weight
        self.gram[:, rows[:, None], rows] += jacobian.swapaxes(1, 2) @ jacobian
        self.score[:, rows] += np.einsum("rkq,rk->rq", jacobian, errors)
        self.cost[:] += np.square(errors).sum(axis=1)


class Search(NamedTuple):
    """The unknowns of a model and records, and their cost.

    The state at each node is `centres` plus an unknown tangent vector of the field's state space.
    """

    problem: Problem  # the comparison and its weights
    centres: Float[Array, "r s d"]  # where the nodes are linearised; the first is the expected start of the record
    deviations: Float[np.ndarray, " p"]  # prior standard deviations of θ from its start (p); infinite if free
    theta: Float[np.ndarray, " p"]  # its start (p)
    segments: Segments  # of the records; one node each, or one for a record in a simulation
    spread: Float[Array | np.ndarray, "#r e"]  # prior standard deviations of each record's start from its centre
    off: Float[np.ndarray, " e"] | None = None  # standard deviation of gaps between segments; None in a simulation
    most: Float[np.ndarray, " p"] | float = np.inf  # largest step of each number of θ

    @property
    def still(self) -> Float[Array, "r q"]:
        return jnp.zeros((len(self.centres), self.centres.shape[1] * self.problem.model.space.tangent_size))

    def model(self, theta) -> Model:
        return ravel_learned(self.problem.model)[1](jnp.asarray(theta))

    def nodes(self, own: Float[Array, "r q"]) -> tuple[Float[Array, "r s d"], Float[Array, "r s d e"]]:
        """Return the states at the nodes, and their derivatives along the changes."""
        return _nodes(self.problem.model, self.centres, own.reshape(*self.centres.shape[:2], -1))

    def local(self, theta, own) -> Local:
        nodes, charts = self.nodes(own)
        if self.off is None and nodes.shape[1] < self.segments.valid.shape[1]:
            return shooting.simulation(self.problem, theta, nodes[:, 0], charts[:, 0], self.segments)
        return shooting.shooting(self.problem, theta, nodes, charts, self.segments)

    def equations(self, theta, own) -> NormalEquations:
        """Return each record's normal equations in θ and its nodes, with the priors of θ and of the starts."""
        local, (nodes, charts), model = self.local(theta, own), self.nodes(own), self.problem.model
        found, p, e = jax.tree.map(np.asarray, local.equations), len(self.theta), model.space.tangent_size
        (r, s, _), zero = nodes.shape, self.still.shape[1] + p
        total = Sums(np.zeros((r, zero, zero)), np.zeros((r, zero)), found.square.sum(axis=1))
        rows = [np.r_[:p, p + j * e : p + (j + 1) * e] for j in range(s)]
        for j in range(found.square.shape[1]):
            at = rows[min(j, s - 1)]
            total.gram[:, at[:, None], at] += found.gram[:, j]
            total.score[:, at] += found.score[:, j]
        if self.off is not None and s > 1:
            ends = local.end[:, :-1], local.slope[:, :-1]
            missing, slopes = map(np.asarray, _missing(model, *ends, nodes[:, 1:], charts[:, 1:]))
            for j in range(s - 1):
                total.add(np.r_[rows[j], rows[j + 1][p:]], slopes[:, j], missing[:, j], self.off)
        one = np.broadcast_to(np.eye(e), (r, e, e))
        total.add(rows[0][p:], one, np.asarray(own)[:, :e], np.asarray(self.spread))
        known = np.zeros((r, p, p))
        known[0] = np.eye(p)  # the prior of θ is added to the first record
        total.add(np.arange(p), known, known @ (np.asarray(theta) - self.theta), self.deviations)
        return NormalEquations(*map(jnp.asarray, total))

    def descend(self, theta, own, free: Bool[np.ndarray, " p"] | None = None, **options) -> End:
        """Minimise the cost; numbers with a prior deviation of 0 do not change, nor those that are not `free`."""
        moves = self.deviations > 0
        return descend(self.equations, theta, own, free=moves if free is None else free, most=self.most, **options)

    def predicted(self, theta, own) -> Predicted:
        model, nodes = self.model(theta), self.nodes(own)[0]
        if self.off is None:
            return shooting.simulated(self.problem, model, nodes[:, 0], self.segments)
        alone = jax.tree.map(lambda leaf: leaf.reshape(-1, 1, *leaf.shape[2:]), self.segments)
        found = shooting.simulated(self.problem, model, nodes.reshape(-1, nodes.shape[-1]), alone)
        return jax.tree.map(lambda leaf: leaf.reshape(*nodes.shape[:2], *leaf.shape[2:]), found)

    def errors(self, theta, own) -> dict[str, Float[np.ndarray, "n k"]]:
        """Return ŷ − y of all samples."""
        found = self.predicted(theta, own).errors
        return {name: np.asarray(each)[self.segments.there[name]] for name, each in found.items()}

    def weighted(self, errors: dict[str, Float[np.ndarray, "n k"]], robust: float = np.inf, known=()) -> "Search":
        """Weight outputs by their errors or `known` sizes; errors above `robust` times the usual one count less."""
        sizes = {name: jnp.asarray(size_of(each, robust)) for name, each in errors.items()} | dict(known)
        return self._replace(problem=dataclasses.replace(self.problem, scale=sizes, robust=robust))

    def part(self, kept) -> "Search":
        segments = jax.tree.map(lambda leaf: leaf[kept], self.segments)
        return self._replace(centres=self.centres[kept], segments=segments, spread=self.spread[kept])


def size_of(errors: Float[np.ndarray, "n k"], robust: float = np.inf) -> Float[np.ndarray, " k"]:
    """Return the RMS of errors, or 1.48 times the median of their sizes, which is robust to outliers."""
    found = np.sqrt(np.mean(errors**2, axis=0)) if np.isinf(robust) else 1.4826 * np.median(np.abs(errors), axis=0)
    return np.maximum(found, TINY)


@eqx.filter_jit
def _nodes(model: Model, centres, changes):
    space = model.space

    def one(centre, change):
        return space.retract(centre, change), jax.jacfwd(partial(space.retract, centre))(change)

    return jax.vmap(jax.vmap(one))(centres, changes)


@eqx.filter_jit
def _missing(model: Model, ends, slopes, nodes, charts):
    """Return the gap from each next node to a segment's end, and its derivative along (θ, node, next node)."""

    def one(end, slope, node, chart):
        of_end, of_node = jax.jacfwd(model.space.difference, (0, 1))(end, node)
        return model.space.difference(end, node), jnp.concatenate([of_end @ slope, of_node @ chart], axis=1)

    return jax.vmap(jax.vmap(one))(ends, slopes, nodes, charts)


def directions(search: Search, end: End, records: Sequence[Record]) -> tuple[str, ...]:
    """Return the directions of θ, and of each start in a simulation, that change no output."""
    p, model = len(search.theta), search.problem.model
    lines = undetermined(np.asarray(jnp.sum(reduced(end.equations, p).equations.gram, axis=0)), learned_names(model))
    if search.off is None:
        names = np.array(model.space.tangent_names)
        free, equations = np.array(model.spread) > 0, search.local(end.theta, end.own).equations
        for record, gram in zip(records, np.asarray(equations.gram)[..., p:, p:].sum(axis=1), strict=True):
            own = undetermined(gram[np.ix_(free, free)], names[free].tolist())
            lines += [f"{line} at the start of {record.name}" for line in own]
    return tuple(lines)


def check_signals(model: Model, records: Sequence[Record], gridded: list[Gridded], dt: float) -> None:
    """Warn of times and angles that seem to have wrong units."""
    found = []
    for record, each in zip(records, gridded, strict=True):
        begin, end = each.start, each.start + len(each.u) * dt
        signals = {name: record.signals[name] for name in (*model.inputs, *model.outputs) if record.signals[name]}
        if SLOW * dt < (interval := min(signal.interval for signal in signals.values())) < np.inf:
            found.append(f"{record.name}: samples are {interval:.3g} s apart, {interval / dt:.3g} times dt: check both")
        for name, signal in signals.items():
            if name in model.inputs:
                most = signal.t[-1] - signal.t[0] > SLOW * (end - begin)
            else:
                most = len(each.index[name]) < len(signal) / 2
                found += [f"{record.name}: {name} {line}" for line in _turns(signal)]
            if most:
                found += [f"{record.name}: most of {name} is not between {begin:.6g} and {end:.6g} s: check all times"]
    for line in found:
        checks.warn(line)


def _turns(signal: Signal) -> list[str]:
    """Return a warning if a signal jumps like a wrapped angle."""
    pairs = np.stack([signal.values[:-1], signal.values[1:]], axis=1)[np.diff(signal.t) < GAP * signal.interval]
    remedies = {2 * np.pi: "jumps by 2π: if it is an angle, pass angles=", 360.0: "jumps by 360: an angle is in rad"}
    narrow = {turn: np.ptp(signal.values, axis=0) < 1.1 * turn for turn in remedies}
    return [line for turn, line in remedies.items() if (turns(pairs, turn) * narrow[turn]).any()]


def check_rates(model: Model, records: Sequence[Record]) -> None:
    """Raise ValueError if an output and its rate, which is another output, have different units in a record."""
    random, m = np.random.default_rng(0), sum(records[0].signals[name].values.shape[1] for name in model.inputs)
    x, u = (jnp.asarray(random.normal(size=(2, k))) for k in (model.size, m))

    def slopes(name):
        return jax.vmap(lambda x, u: jax.jvp(lambda x: model.output(name, x, u), (x,), (model.field(x, u),)))(x, u)

    found = {name: slopes(name) for name in model.outputs}
    for name, rate in itertools.permutations(found, 2):
        same = found[name][1].shape == found[rate][0].shape and jnp.allclose(found[name][1], found[rate][0])
        for record in records if same else ():
            moved, measured = record.signals[name], record.signals[rate]
            if not (moved and measured):
                continue
            inside = (moved.t >= measured.t[0]) & (moved.t <= measured.t[-1])
            t, steps = moved.t[inside], np.diff(measured.t)
            # What changed while the rate was not measured is unknown.
            seen = steps[np.searchsorted(measured.t, t[1:]) - 1] < GAP * np.sum(steps) / len(measured.t)
            both = moved.values[inside], integral(measured, t, "linear")
            both = (np.cumsum(np.diff(each, axis=0) * seen[:, None], axis=0) for each in both)
            a, b = ((each - each.sum(axis=0) / max(len(each), 1)).reshape(-1, 1) for each in both)
            if gain := float(foreign_units(a, b)[0, 0]):
                raise ValueError(f"{record.name}: {rate} is {gain:.3g} times the rate of {name}: check their units")


def steps_of(segment: float | None, gridded: list[Gridded], dt: float) -> int:
    longest = max(len(each.u) for each in gridded)
    if segment is not None and segment > (longest + 1) * dt:
        raise ValueError(f"segment must be at most the {longest * dt:.3g} s of the longest record, got {segment:.3g}")
    return max(1, round(segment / dt)) if segment is not None else -(-longest // max(1, min(CLUSTERS, longest // 10)))


def approached(search: Search, segment: float | None) -> tuple[Search, Float[Array, " p"], Float[Array, "r q"]]:
    """Return the start of the search; with segments, multiple shooting with smaller and smaller gaps improves it."""
    space, theta, own = search.problem.model.space, jnp.asarray(search.theta), search.still
    if segment is None:
        return search, theta, own
    if len(theta) + own.size > MOST:
        raise ValueError(f"segment: {own.size} unknown initial states are too many; use {segment * 2:.3g} s or more")
    size = sizes_of(search, theta, own)
    none = np.zeros(len(theta), bool)
    if search.problem.model.angles:
        search, own = _followed(search, theta, APPROACH[0] * size)
    for i, share in enumerate((APPROACH[0], *APPROACH)):
        search = search._replace(off=share * size)
        found = search.descend(theta, own, free=None if i else none)
        theta, nodes = found.theta, search.nodes(found.own)[0]
        if not i:
            moved = np.asarray(_changes(space, nodes, search.centres[:1, :1]))
            size = np.maximum(np.std(moved, axis=(0, 1)), SMALL * size)
        own = found.own.at[:, space.tangent_size :].set(0.0)
        search = search._replace(centres=nodes.at[:, 0].set(search.centres[:, 0]))
    return search, theta, own


def _followed(search: Search, theta, off: Float[np.ndarray, " e"]) -> tuple[Search, Float[Array, "r q"]]:
    """Fit one node after another, from where the previous segment ends: an angle then has the right number of turns."""
    x, spread, nodes, own = search.centres[:, 0], search.spread, [], search.still
    for j in range(search.centres.shape[1]):
        segments = jax.tree.map(lambda leaf, j=j: leaf[:, j : j + 1], search.segments)
        part = search._replace(centres=x[:, None], segments=segments, spread=spread)
        end = part.descend(theta, part.still, free=np.zeros(len(theta), bool))
        nodes.append(part.nodes(end.own)[0][:, 0] if j else x)
        own = own if j else own.at[:, : end.own.shape[1]].set(end.own)
        x, spread = part.predicted(theta, end.own).states[:, 0, -1], off[None]
    return search._replace(centres=jnp.stack(nodes, axis=1)), own


def sizes_of(search: Search, theta, own) -> Float[np.ndarray, " e"]:
    """Return the size of each state: its variation in a simulation, where finite."""
    model = search.problem.model
    start, spread = np.array(model.start), np.array(model.spread)
    states = search._replace(off=None).predicted(theta, own).states
    moved = sizes_between(model.space, states.reshape(-1, len(start)), start)
    far = np.maximum(np.abs(start), 1.0) if len(spread) == len(start) else np.ones(len(spread))
    guess = np.where(np.isfinite(spread) & (spread > 0), spread, far)
    return np.where(np.isfinite(moved) & (moved > 0) & (moved < 1e3 * guess), moved, guess)


def sizes_between(space: StateSpace, states: Float[Array | np.ndarray, "t d"], x) -> Float[np.ndarray, " e"]:
    """Return the largest distance between states and x, number by number."""
    return np.abs(np.asarray(_changes(space, jnp.asarray(states)[None], x))).max(axis=(0, 1))


def _changes(space: StateSpace, y: Float[Array, "r s d"], x) -> Float[Array, "r s e"]:
    return jnp.vectorize(space.difference, signature="(d),(d)->(e)")(y, jnp.asarray(x))
