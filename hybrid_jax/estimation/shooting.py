"""Errors and normal equations of a model along records in which only some states were measured.

In a *simulation* only the initial state of a record is unknown. In *multiple shooting* (Bock 1983) each segment has an
unknown initial state, and the gaps between segments count as process noise, as in full-information estimation (Rao,
Rawlings and Mayne 2003); this converges from poorer starts.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax.batches import in_chunks
from hybrid_jax.dynamics.base import ravel_learned
from hybrid_jax.estimation.normal_equations import NormalEquations, equations_of
from hybrid_jax.integrate import Solver, integrate
from hybrid_jax.records import Gridded

CHUNK = 64  # records at a time
Model = Any  # a `StateSpaceModel`, or what has its methods


class Segments(NamedTuple):
    """r records of s segments of t intervals, padded where a record is shorter."""

    u: Float[Array | np.ndarray, "*r s a+t m"]  # mean inputs, after those of earlier intervals that the model needs
    valid: Bool[Array | np.ndarray, "*r s t"]  # which intervals are within the record
    y: dict[str, Float[Array | np.ndarray, "*r s n k"]]  # the samples of each output, 0 if missing
    there: dict[str, Bool[Array | np.ndarray, "*r s n"]]  # which samples exist
    index: dict[str, Int[Array | np.ndarray, "*r s n"]]  # the interval of the segment that contains each sample
    share: dict[str, Float[Array | np.ndarray, "*r s n"]] | None  # position in it, 0 to 1; None if always at the end
    whitening: Float[Array | np.ndarray, "*r s e e"] | None = None  # of all errors of a segment, by default none


def rounded_up(n: int, fine: int = 16) -> int:
    """Return the next power of two, from `fine` on of four sizes per octave: similar records share programs."""
    unit = 2 ** (int(n - 1).bit_length() if n < fine else int(n).bit_length() - 3)
    return -(-int(n) // unit) * unit


def cut(records: list[Gridded], steps: int, *, exact: bool = False) -> Segments:
    """Cut records into segments; unless `exact`, there is room for more samples than there are, see `rounded_up`."""
    most = max(-(-len(each.u) // steps) for each in records)
    parts = [_cut(each, steps, most) for each in records]
    widest = {name: max(part.there[name].shape[-1] for part in parts) for name in records[0].y}
    widest = widest if exact else {name: rounded_up(n) for name, n in widest.items()}

    def filled(path, *leaves):
        name = path[-1].key if len(path) > 1 else None
        n = 0 if name is None else widest[name]
        pads = [((0, 0), (0, n - leaf.shape[1]), *[(0, 0)] * (leaf.ndim - 2)) for leaf in leaves] if n else ()
        return np.stack([np.pad(*each) for each in zip(leaves, pads, strict=True)] if n else leaves)

    return jax.tree_util.tree_map_with_path(filled, *parts)


def _cut(record: Gridded, steps: int, most: int) -> Segments:
    u = record.u[np.minimum(np.arange(most * steps), len(record.u) - 1)].reshape(most, steps, -1)
    valid = (np.arange(most * steps) < len(record.u)).reshape(most, steps)
    found = {}
    for name, at in record.index.items():
        segment = at // steps
        counts = np.bincount(segment, minlength=most)
        place = np.arange(len(at)) - np.repeat(np.cumsum(counts) - counts, counts)  # samples are in order of time
        shape = most, max(counts.max(), 1)
        parts = (record.y[name], np.ones(len(at), bool), at % steps, record.share[name])
        found[name] = []
        for part in parts:
            array = np.zeros((*shape, *part.shape[1:]), part.dtype)
            array[segment, place] = part
            found[name].append(array)
    y, there, index, share = ({name: each[i] for name, each in found.items()} for i in range(4))
    return Segments(u, valid, y, there, index, share)


class Problem(eqx.Module):
    """The comparison of a model with measurements, and the weights of errors."""

    model: Model  # its learned numbers are the start of the search
    scale: dict[str, Float[Array, " k"]]  # the size of an error that counts as 1, of each output (k)
    robust: float = eqx.field(static=True)  # errors above this many times the scale count linearly (Huber 1964)
    dt: float = eqx.field(static=True)  # length of an interval [s]
    solver: Solver = eqx.field(static=True)  # integrates the field over an interval
    substeps: int = eqx.field(static=True)  # steps of the solver in each interval


def states_of(problem: Problem, model: Model, x0: Float[Array, " d"], segment: Segments):
    """Return the states at the edges of a segment's intervals (t + 1, d), constant after the record; and inputs."""
    x0, u = model.begin(x0, jnp.asarray(segment.u), problem.dt)
    states = jnp.concatenate([x0[None], integrate(model.field, x0, u, problem.dt, problem.solver, problem.substeps)])
    last = jnp.sum(segment.valid)
    return jnp.where((jnp.arange(len(states)) <= last)[:, None], states, states[last]), u


def outputs_of(
    model: Model, states, u, segment: Segments, dt: float, slopes: Float[Array, "2 i d"] | None = None
) -> dict[str, Float[Array, "n k"]]:
    """Return the outputs at the times of their samples, by cubic interpolation of the states."""
    if (shares := segment.share) is None:
        return {name: jax.vmap(partial(model.output, name))(states[i + 1], u[i]) for name, i in segment.index.items()}
    # The input jumps at an edge.
    starts, ends = (jax.vmap(model.field)(x, u) for x in (states[:-1], states[1:])) if slopes is None else slopes

    def one(name, i, s):
        a, b, c, d = states[i], states[i + 1], dt * starts[i], dt * ends[i]
        x = a * (1 + 2 * s) * (1 - s) ** 2 + b * s**2 * (3 - 2 * s) + c * s * (1 - s) ** 2 + d * s**2 * (s - 1)
        return model.output(name, x, u[i])

    return {name: jax.vmap(partial(one, name))(i, jnp.asarray(shares[name])) for name, i in segment.index.items()}


def errors_of(problem: Problem, model: Model, x0, segment: Segments):
    """Return a segment's errors over their scale as a vector, zero if not measured; and the state at its end."""
    found = predicted(problem, model, x0, segment)
    rows = jnp.concatenate([(error / problem.scale[name]).ravel() for name, error in found.errors.items()])
    return rows if segment.whitening is None else segment.whitening @ rows, found.states[-1]


class Predicted(NamedTuple):
    """A model's prediction of a segment: outputs, their errors, and the states at the edges of intervals."""

    y: dict[str, Float[Array, "*s n k"]]
    errors: dict[str, Float[Array, "*s n e"]]
    states: Float[Array, "*s t d"]


def predicted(problem: Problem, model: Model, x0, segment: Segments) -> Predicted:
    segment = segment._replace(index=jax.tree.map(jnp.asarray, segment.index))
    return compared(model, *states_of(problem, model, x0, segment), segment, problem.dt)


def compared(
    model: Model,
    states: Float[Array, "t d"],
    u: Float[Array, "i m"],
    segment: Segments,
    dt: float,
    slopes: Float[Array, "2 i d"] | None = None,
) -> Predicted:
    """Return the prediction of a segment whose states at the edges of intervals, and inputs, are known."""
    y, errors = outputs_of(model, states, u, segment, dt, slopes), {}
    for name, each in y.items():
        error = jax.vmap(partial(model.error, name))(each, jnp.asarray(segment.y[name]))
        errors[name] = jnp.where(segment.there[name][:, None], error, 0.0)
    return Predicted(y, errors, states)


class Local(NamedTuple):
    """Normal equations of segments in (θ, the unknowns of their start), and the end's derivatives along both."""

    equations: NormalEquations
    slope: Float[Array, "*s d q"]
    end: Float[Array, "*s d"]


def local(problem: Problem, theta, x0, through: Float[Array, "d q"], segment: Segments) -> Local:
    """Return the normal equations of one segment, where `through` is the derivative of its start."""
    p, unravel = len(theta), ravel_learned(problem.model)[1]

    def errors(z):
        found = errors_of(problem, unravel(z[:p]), z[p:], segment)
        return found, found

    (jacobian, slope), (r, end) = jax.jacfwd(errors, has_aux=True)(jnp.concatenate([theta, x0]))
    both = jnp.concatenate([jnp.eye(p, through.shape[1]), through])
    return Local(equations_of(jacobian @ both, r, problem.robust), slope @ both, end)


@eqx.filter_jit
def shooting(problem: Problem, theta, nodes: Float[Array, "r s d"], charts: Float[Array, "r s d e"], segments) -> Local:
    """Return the normal equations of every segment in (θ, change of its own initial state)."""
    slopes = jnp.concatenate([jnp.zeros((*nodes.shape, len(theta))), charts], axis=-1)
    every = jax.vmap(jax.vmap(partial(local, problem, theta)))
    return in_chunks(lambda each: every(*each), (nodes, slopes, segments), CHUNK)


@eqx.filter_jit
def simulation(problem: Problem, theta, starts: Float[Array, "r d"], charts: Float[Array, "r d e"], segments) -> Local:
    """Return the normal equations of every segment in (θ, change of the record's initial state), in sequence."""

    def record(x0, chart, own):
        def step(carry, segment):
            found = local(problem, theta, carry[0], carry[1], segment)
            return (found.end, found.slope), found

        slope = jnp.concatenate([jnp.zeros((len(x0), len(theta))), chart], axis=1)
        return jax.lax.scan(step, (x0, slope), own)[1]

    return jax.vmap(record)(starts, charts, segments)


@eqx.filter_jit
def simulated(problem: Problem, model: Model, starts, segments: Segments) -> Predicted:
    def step(x, segment):
        found = predicted(problem, model, x, segment)
        return found.states[-1], found

    return jax.vmap(lambda x0, own: jax.lax.scan(step, x0, own)[1])(starts, segments)


@eqx.filter_jit
def effects(problem: Problem, model: Model, starts: Float[Array, "r d"], segments: Segments, changes):
    """Return errors of records of one segment, and their derivative along changes of their inputs (r, k, a + t, m)."""

    def one(each):
        x0, segment, ways = each

        def errors(size):
            found = errors_of(problem, model, x0, segment._replace(u=segment.u + jnp.tensordot(size, ways, 1)))[0]
            return found, found

        along, r = jax.jacfwd(errors, has_aux=True)(jnp.zeros(len(ways)))
        return r, along

    return in_chunks(jax.vmap(one), (starts, jax.tree.map(lambda leaf: leaf[:, 0], segments), changes), CHUNK)
