"""Windows of records in which only some states were measured, to train networks by `fit`."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import as_field, in_double, ravel_learned
from hybrid_jax.dynamics.composition import Frozen
from hybrid_jax.dynamics.outputs import Measured, StateSpaceModel
from hybrid_jax.estimation import shooting
from hybrid_jax.estimation.discretisation import Solver
from hybrid_jax.estimation.elimination import End, undetermined
from hybrid_jax.estimation.record_search import Search
from hybrid_jax.estimation.shooting import Problem, Segments
from hybrid_jax.implicit_solvers import solver_errors
from hybrid_jax.integrate import RK4
from hybrid_jax.records import Between, Gridded, Record, completed, on_grid
from hybrid_jax.runtime import entry
from hybrid_jax.status import Status
from hybrid_jax.trajectories import Trajectories

NEAR = 0.25, 0.5, 1.0  # shares of a piece whose samples count, one after the other
ROUNDING = 1e-6  # of a sample's time, in intervals


class RecordWindows(eqx.Module):
    """n windows of records: an estimated initial state, the inputs, and the samples of outputs at times of their own.

    Attributes:
        states: the estimated initial states, the inputs, and the states that the model predicted in the windows.
        segments: the samples.
        noise: standard deviation of each component of an output's errors, by name.
        robust: errors beyond this many times the noise count linearly.
    """

    states: Trajectories
    segments: Segments
    noise: tuple[tuple[str, tuple[float, ...]], ...] = eqx.field(static=True)
    robust: float = eqx.field(static=True, default=np.inf)

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, index) -> "RecordWindows":
        """Return the windows at a slice or an array of indices, which may be traced."""
        return jax.tree.map(lambda leaf: leaf[index], self)

    @property
    def samples(self) -> Float[Array, ""]:
        """The number of measured numbers in all windows, at least 1."""
        counts = (len(sizes) * jnp.sum(self.segments.there[name]) for name, sizes in self.noise)
        return jnp.maximum(sum(counts, jnp.zeros(())), 1)

    def errors(
        self, model: StateSpaceModel, x: Float[Array, "t d"], slopes: Float[Array, "2 t d"] | None = None
    ) -> Float[Array, " r"]:
        """Return the errors of one window's samples, relative to the noise; 0 where there is no sample.

        Beyond `robust` they are smaller: their squares grow linearly, as in Huber's loss.

        Args:
            model: the model, whose outputs are compared.
            x: its states at the ends of intervals.
            slopes: ẋ at both ends of each interval, if you have it.

        Raises:
            ValueError: if the model lacks an output that was measured.
        """
        for name in (name for name, _ in self.noise if name not in model.outputs):
            raise ValueError(f"field: has no output {name}; it has {', '.join(model.outputs)}")
        states, u = jnp.concatenate([self.states.x0[None], x]), jnp.asarray(self.states.u)
        if self.segments.share is None:  # a sample at an edge belongs to the interval that begins there
            u = jnp.concatenate([u[1:], u[-1:]])
        found = shooting.compared(model, states, u, self.segments, self.states.dt, slopes).errors
        rows = jnp.concatenate([(found[name] / jnp.array(sizes)).ravel() for name, sizes in self.noise])
        if np.isinf(self.robust):
            return rows
        far = jnp.maximum(jnp.abs(rows), self.robust)
        return jnp.where(far > self.robust, jnp.sign(rows) * jnp.sqrt(self.robust * (2 * far - self.robust)), rows)

    def loss(self, model: StateSpaceModel, x: Float[Array, "n t d"]) -> Float[Array, ""]:
        """Return the mean squared error of all samples, see `errors`.

        Args:
            model: the model, whose outputs are compared.
            x: its states at the ends of intervals, in all windows.
        """
        slopes = None if self.segments.share is None else self._slopes(model, x)
        rows = jax.vmap(lambda *each: each[0].errors(model, *each[1:]))(self, x, slopes)
        return jnp.sum(jnp.square(rows)) / self.samples

    def _slopes(self, model: StateSpaceModel, x: Float[Array, "n t d"]) -> Float[Array, "n 2 t d"]:
        """Return ẋ at both ends of each interval; as columns of all windows, since this takes half the time."""
        ends = jnp.stack([jnp.concatenate([self.states.x0[:, None], x[:, :-1]], axis=1), x], axis=1)
        held = jnp.broadcast_to(self.states.u[:, None], (*ends.shape[:-1], self.states.u.shape[-1]))
        columns = (jax.lax.collapse(jnp.moveaxis(each, -1, 0), 1) for each in (ends, held))
        return as_field(model.field).infer_batch(*columns).T.reshape(ends.shape)


def checked_windows(windows: RecordWindows, name: str) -> RecordWindows:
    checks.instance(name, windows, RecordWindows)
    if not len(windows):
        raise ValueError(f"{name} must contain at least one window")
    return windows


def states_of(windows: Trajectories | RecordWindows) -> Trajectories:
    return windows.states if isinstance(windows, RecordWindows) else windows


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
) -> RecordWindows:
    """Return windows for `fit`, whose initial states are estimated from the samples around them.

    The model predicts the samples from `around` seconds before to `around` seconds after the start of a window, by
    least squares. If the model has a constant error, its effects before and after the start nearly cancel. `fit` then
    trains a `StateSpaceModel` on the samples in the windows, at their own times; the initial states stay.

    Args:
        model: the model with known numbers, and the noise of every output, for example that of `fit_records`. The
            search for an initial state begins at `start`, and at the first sample of each output that is a state.
        records: one or more records. Windows in a gap, whose initial state no sample determines, are left out.
        dt: length of the intervals [s].
        steps: number of intervals in each window. Windows follow each other.
        around: time before and after the start of a window in which samples count [s]. With a longer one, noise
            matters less, and errors of the model more.
        between: how inputs act between their samples: "held", "linear" or "averaged", see `records.on_grid`.
        robust: errors beyond this many times the noise count linearly, also in `fit`.
        solver: a solver of diffrax, by default `RK4`.
        substeps: number of solver steps in each interval.

    Raises:
        ValueError: if an output has no noise, a record lacks an input or all outputs, all records are too short, no
            sample determines an initial state, or an argument is out of range.
    """
    records = checks.list_of("records", records, Record)
    checks.instance("model", model, StateSpaceModel)
    checks.count("steps", steps)
    for name, seconds in (("dt", dt), ("around", around)):
        checks.positive(name, seconds, "a positive number of seconds")
    if around < dt:
        raise ValueError(f"around must be at least dt = {dt:.3g} s, got {checks.short_repr(around)}")
    model, half = measured_outputs(model, records), round(around / dt)
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
        near = [_part(model, each, i - half, 2 * half) for each, i in places]
        end, states = _estimated(problem, np.stack([_guess(model, each) for each in near]), near)
        windows = [_part(model, each, i, steps) for each, i in places]
        own = _search(problem, states[:, half], windows)
        found = own.predicted(own.theta, own.still)
        x, errors = np.asarray(found.states)[:, 0, 1:], found.errors
    if end.status != Status.OK:
        checks.warn(f"records: the search for initial states {end.status.message}; check all units and the model")
    kept = _determined(model, end) & np.any([there.any(axis=(1, 2)) for there in own.segments.there.values()], axis=0)
    segments = _at_edges(jax.tree.map(lambda leaf: leaf[kept, 0], own.segments))
    path, segments = jax.tree.map(
        lambda leaf: leaf.astype(dtype) if leaf.dtype == float else leaf,
        (Trajectories(states[kept, half], segments.u, x[kept], dt), segments),
    )
    noise = {name: np.broadcast_to(sizes, errors[name].shape[-1]).tolist() for name, sizes in model.noise.items()}
    return RecordWindows(path, segments, tuple((name, tuple(sizes)) for name, sizes in noise.items()), robust)


def measured_outputs(model: StateSpaceModel, records: Sequence[Record]) -> StateSpaceModel:
    """Return the model with the measured outputs only; ValueError if the noise of one is not known."""
    seen = {name for each in records for name, signal in each.signals.items() if len(signal)}
    model = model.only([name for name in model.outputs if name in seen] or model.outputs)
    for name in model.outputs.keys() - model.noise.keys():
        raise ValueError(f"noise: {name} has none; the model that fit_records returns has it")
    return model


def _at_edges(segments: Segments) -> Segments:
    """Return segments that need no interpolation, if all samples are at the ends of intervals or at the start."""
    assert segments.share is not None
    index, there = dict(segments.index), dict(segments.there)
    for name, share in segments.share.items():
        near = np.round(share)
        if np.abs(np.where(there[name], share - near, 0)).max(initial=0) > ROUNDING:
            return segments
        index[name] = index[name] + near.astype(int) - 1
        there[name] = there[name] & (index[name] >= 0)  # at the start no prediction is compared
    return segments._replace(index=index, there=there, share=None)


def _part(model: StateSpaceModel, record: Gridded, first: int, steps: int) -> Gridded:
    """Return some intervals of a record, with the samples from their start to their end.

    A sample at the very end belongs to the next interval, whose input only the outputs that are states do not need.
    """
    y, index, share = {}, {}, {}
    for name, values in record.y.items():
        own = record.index[name] - first
        at = own + record.share[name]
        inside = (own >= 0) & (at < steps + ROUNDING if isinstance(model.outputs[name], Measured) else own < steps)
        index[name] = np.minimum(own[inside], steps - 1)
        y[name], share[name] = values[inside], np.minimum(at[inside] - index[name], 1.0)
    return Gridded(record.start, record.u[first : first + steps], y, index, share)


def _guess(model: StateSpaceModel, record: Gridded) -> Float[np.ndarray, " d"]:
    """Return the first measured states, and the model's start in place of others."""
    x = np.array(model.start)
    for name, values in record.y.items():
        if len(values) and isinstance(h := model.outputs[name], Measured):
            x[slice(*h.part)] = values[0]
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
    theta, free = (
        np.asarray(ravel_learned(problem.model)[0], float),
        np.full((1, problem.model.space.tangent_size), np.inf),
    )
    segments = shooting.cut(pieces, len(pieces[0].u), exact=True)
    return Search(problem, jnp.asarray(centres)[:, None], np.zeros(len(theta)), theta, segments, free)


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
