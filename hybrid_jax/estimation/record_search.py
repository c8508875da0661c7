"""The search for the parameters and initial states of records, see `record_fit`."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hybrid_jax.dynamics.base import ravel_learned, trainable
from hybrid_jax.dynamics.outputs import StateSpaceModel
from hybrid_jax.estimation import levenberg_marquardt, shooting
from hybrid_jax.estimation.shooting import Local, Problem, Segments
from hybrid_jax.records import Gridded
from hybrid_jax.status import Status

APPROACH = (1.0, 0.1, 0.01)  # what a segment's end may be off, over the size of a state, in turn
MOST = 3000  # unknowns
ENOUGH = 1e-6  # stop at a step that lowers the cost by less than this share
CLUSTERS = 20  # of a simulation's errors, each taken as one observation
TINY, SMALL = 1e-12, 1e-3


class System(NamedTuple):
    """Normal equations in all unknowns: θ, then the states at the nodes."""

    gram: Float[np.ndarray, "z z"]
    score: Float[np.ndarray, " z"]
    cost: float

    def plus(self, rows, jacobian, errors, deviations) -> "System":
        """With more errors, of known standard deviations; an infinite one counts nothing."""
        weight = 1 / np.maximum(deviations, TINY)
        jacobian, errors = jacobian * weight[:, None], errors * weight
        self.gram[np.ix_(rows, rows)] += jacobian.T @ jacobian
        self.score[rows] += jacobian.T @ errors
        return self._replace(cost=self.cost + float(errors @ errors))


class Search(NamedTuple):
    """The unknowns z = (θ, nodes) of a model and records, and how they are judged.

    Attributes:
        problem: what is compared.
        gridded: the records.
        deviations: of θ from its start that are expected (p); infinite where nothing is.
        theta: its start (p).
        segments: the records cut; one node each, or one for a record in a simulation.
        off: what the end of a segment may be off the next node (d); None in a simulation.
    """

    problem: Problem
    gridded: list[Gridded]
    deviations: Float[np.ndarray, " p"]
    theta: Float[np.ndarray, " p"]
    segments: Segments
    off: Float[np.ndarray, " d"] | None = None

    def model(self, z) -> StateSpaceModel:
        return ravel_learned(self.problem.model)[1](jnp.asarray(z[: len(self.theta)]))

    def nodes(self, z) -> Float[np.ndarray, "r s d"]:
        return z[len(self.theta) :].reshape(len(self.gridded), -1, self.problem.model.size)

    def local(self, z) -> Local:
        theta, nodes = jnp.asarray(z[: len(self.theta)]), jnp.asarray(self.nodes(z))
        if self.off is None:
            found = shooting.simulation(self.problem, theta, nodes[:, 0], self.segments)
        else:
            found = shooting.shooting(self.problem, theta, nodes, self.segments)
        return jax.tree.map(np.asarray, found)

    def system(self, z) -> System:
        """The normal equations in all unknowns, with what is expected of θ and of the starts."""
        found, nodes, model, p = self.local(z), self.nodes(z), self.problem.model, len(self.theta)
        total = System(np.zeros((len(z), len(z))), np.zeros(len(z)), float(found.cost.sum()))
        for i, own in enumerate(nodes):
            places = [np.r_[:p, place(p, nodes, i, j)] for j in range(len(own))]
            for j, (gram, score) in enumerate(zip(found.gram[i], found.score[i], strict=True)):
                rows = places[j if self.off is not None else 0]
                total.gram[np.ix_(rows, rows)] += gram
                total.score[rows] += score
            for j in range(len(own) - 1 if self.off is not None else 0):
                rows = np.r_[places[j], places[j + 1][p:]]
                slope = np.concatenate([found.slope[i, j], -np.eye(model.size)], axis=1)
                total = total.plus(rows, slope, found.end[i, j] - own[j + 1], self.off)
            rows = places[0][p:]
            total = total.plus(rows, np.eye(model.size), own[0] - np.array(model.start), np.array(model.spread))
        return total.plus(np.arange(p), np.eye(p), z[:p] - self.theta, self.deviations)

    def predicted(self, z):
        """The outputs and states of a simulation of each record, or of each segment from its node."""
        nodes = jnp.asarray(self.nodes(z))
        model = self.model(z)
        if self.off is None:
            return shooting.simulated(self.problem, model, nodes[:, 0], self.segments)
        alone = jax.tree.map(lambda leaf: leaf.reshape(-1, 1, *leaf.shape[2:]), self.segments)
        found = shooting.simulated(self.problem, model, nodes.reshape(-1, nodes.shape[-1]), alone)
        return jax.tree.map(lambda leaf: leaf.reshape(*nodes.shape[:2], *leaf.shape[2:]), found)

    def errors(self, z) -> dict[str, Float[np.ndarray, "n k"]]:
        """ŷ − y of all samples."""
        y, segments = self.predicted(z)[0], self.segments
        return {name: (np.asarray(y[name]) - segments.y[name])[segments.there[name]] for name in y}


def place(p: int, nodes: Float[np.ndarray, "r s d"], i: int, j: int) -> np.ndarray:
    """Where node j of record i is among the unknowns."""
    _, s, d = nodes.shape
    first = p + (i * s + j) * d
    return np.arange(first, first + d)


def deviations_of(model: StateSpaceModel, prior: Mapping[str, float]) -> Float[np.ndarray, " p"]:
    """What is expected of each learned number; ValueError for a path that there is none of."""
    learned = eqx.filter(model, trainable(model))
    leaves = jax.tree_util.tree_leaves_with_path(learned)
    names, found, used = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves], [], set()
    for name, (_, leaf) in zip(names, leaves, strict=True):
        chosen = [each for each in prior if name == each or name.startswith(f"{each}.")]
        used.update(chosen)
        found.append(np.full(leaf.size, prior[max(chosen, key=len)] if chosen else np.inf))
    for name in prior.keys() - used:
        raise ValueError(f"prior: the model has no {name}; it has {', '.join(names)}")
    return np.concatenate(found) if found else np.zeros(0)


def steps_of(segment: float | None, gridded: list[Gridded], dt: float) -> int:
    longest = max(len(each.u) for each in gridded)
    return max(1, round(segment / dt)) if segment is not None else -(-longest // max(1, min(CLUSTERS, longest // 10)))


def approached(search: Search, segment: float | None) -> Float[np.ndarray, " z"]:
    """The unknowns from which the search begins: through multiple shooting, whose segments drift less and less."""
    model, p = search.problem.model, len(search.theta)
    start = np.array(model.start)
    if segment is None:
        return np.concatenate([search.theta, np.tile(start, len(search.gridded))])
    r, s = search.segments.valid.shape[:2]
    if p + r * s * len(start) > MOST:
        raise ValueError(f"segment: {r * s} segments of {len(start)} states are too many; {segment * 2:.3g} s or more")
    z = np.concatenate([search.theta, np.tile(start, r * s)])
    size = sizes_of(search, z)
    free = np.ones(len(z), bool)
    free[:p] = False
    for i, share in enumerate((APPROACH[0], *APPROACH)):
        z = descend(search._replace(off=share * size).system, z, np.ones(len(z), bool) if i else free).z
        size = np.maximum(np.std(search.nodes(z), axis=(0, 1)), SMALL * size) if not i else size
    return z


def sizes_of(search: Search, z) -> Float[np.ndarray, " d"]:
    """The size of each state: as it moves in a simulation, where that is finite."""
    p, start = len(search.theta), np.array(search.problem.model.start)
    spread = np.array(search.problem.model.spread)
    alone = search._replace(off=None)
    states = np.asarray(alone.predicted(z)[1]) if len(z) else np.zeros((0, p))
    moved = np.abs(states - start).reshape(-1, len(start)).max(axis=0)
    guess = np.where(np.isfinite(spread) & (spread > 0), spread, np.maximum(np.abs(start), 1.0))
    return np.where(np.isfinite(moved) & (moved > 0) & (moved < 1e3 * guess), moved, guess)


class End(NamedTuple):
    """Where a search ended."""

    z: Float[np.ndarray, " z"]
    gram: Float[np.ndarray, "z z"]
    score: Float[np.ndarray, " z"]
    steps: int
    status: Status


def descend(system, z, free=None, max_steps: int = 50) -> End:
    """The unknowns at the least cost; those that are not free stay as they are."""
    free = np.ones(len(z), bool) if free is None else free

    def evaluate(z, state):
        found = system(np.asarray(z))
        gram, score = np.where(free[:, None] & free, found.gram, 0.0), np.where(free, found.score, 0.0)
        return jnp.asarray(found.cost), (z, jnp.asarray(gram), jnp.asarray(score))

    def aim(best, damping):
        move, expected = levenberg_marquardt.move_of_equations(best[1], best[2], damping)
        return best[0] + move, expected, 0.0

    n, z = len(z), jnp.asarray(z)
    begin = levenberg_marquardt.begin(z, (z, jnp.zeros((n, n)), jnp.zeros(n)))
    end = levenberg_marquardt.minimise(evaluate, aim, begin, max_steps, ENOUGH, levenberg_marquardt.in_python)
    z, gram, score = map(np.asarray, end.best)
    return End(z, gram, score, int(end.steps), Status(int(end.status)))
