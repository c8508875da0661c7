"""Identify a vehicle from recordings of its commands and sensors.

The initial state of a window has a prior from earlier samples (an arrival cost; Rao, Rawlings and Mayne 2003). Each
window also has a constant force and torque, for example wind or a sagging battery, whose variance is estimated
(empirical Bayes by expectation maximisation; Dempster, Laird and Rubin 1977).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hybrid_jax.dynamics import Actuated, RandomWalk, with_hidden
from hybrid_jax.dynamics.base import AbstractVectorField, in_double, ravel_learned, trainable
from hybrid_jax.dynamics.disturbance import physics_of
from hybrid_jax.dynamics.terms import OF_VELOCITY
from hybrid_jax.estimation import Interval, uncertainty
from hybrid_jax.estimation.elimination import descend, reduced
from hybrid_jax.estimation.normal_equations import NormalEquations, inverse, inverses, masked
from hybrid_jax.estimation.record_search import Search
from hybrid_jax.estimation.shooting import Problem, effects
from hybrid_jax.flights.recording import Recording
from hybrid_jax.identification import slow_commands
from hybrid_jax.identification.multirotor import PUSHED, TANGENT, Multirotor
from hybrid_jax.identification.recordings import Layout, Windows, cut
from hybrid_jax.integrate import RK4
from hybrid_jax.runtime import entry
from hybrid_jax.status import Status
from hybrid_jax.vehicle import STATE_SIZE

ROUNDS, MAX_STEPS = 3, 20  # rounds with new weights, and Levenberg–Marquardt steps in each
CANDIDATES = 8  # windows from which each fitted one is selected
CLUSTER, FEWEST_CLUSTERS = 2.0, 6  # s of windows that form one observation, and fewest observations
OF_FORCE = {"curve", "time_constant", "time_constants", "voltage_exponent", "mass", "k", "k_rotors", "drag"}
FORCE_STEPS = 5  # factor by which windows for forces are longer: no instability limits them
AXES_OF = {"Ix": 0, "Iy": 1, "Iz": 2, "torque_coefficient": 2}
TOLERANCE = 1e-5  # share of the cost: a step that lowers it by less is slow
NO_EFFECT = 1.0  # information below which a parameter is not identifiable: its standard error is its size


class Identified(NamedTuple):
    """The result of `identify`.

    Attributes:
        field: the field with the fitted parameters.
        intervals: the 95 % confidence interval of each parameter, number by number.
        errors: the RMS error of each quantity's channels over the windows, from the estimated initial states.
        windows: the number of fitted windows.
        seconds: the length of all windows [s].
        status: how the last round ended.
        covariance: the covariance (p, p) of the parameters, in the parametrisation of `ravel_parameters`.
        explained: R² of the change of each body rate in a window (3); 1 if not measured.
    """

    field: AbstractVectorField
    intervals: dict[str, Interval]
    errors: dict[str, np.ndarray]
    windows: int
    seconds: float
    status: Status
    covariance: Float[np.ndarray, "p p"]
    explained: Float[np.ndarray, "3"]

    @property
    def converged(self) -> bool:
        """Whether the last round stopped by itself, because no step lowered the errors further."""
        return self.status == Status.OK


@entry
def identify(
    field: AbstractVectorField,
    recordings: Sequence[Recording],
    layout: Layout | None = None,
    measured: Sequence[str] = (),
    *,
    free: Sequence[str] | None = None,
    known: Float[np.ndarray, "p p"] | None = None,
) -> Identified:
    """Fit the learned parameters of the field's physics to recordings of commands and sensors.

    Args:
        field: an `Actuated` field if the input is commands; any other field takes the measured rotor speeds.
        recordings: one or more recordings of one vehicle.
        layout: how they are cut into windows, by default `Layout()`.
        measured: the quantities to compare; by default all that every recording has.
        free: names of the parameters to fit, for example "k" or "efficiency[2]"; by default all.
        known: covariance of the parameters that are not fitted, which widens the intervals of the others; by default 0.

    Returns:
        A parameter that is not identifiable does not change and has an infinite interval, for example those in
        `terms.OF_VELOCITY` unless each recording has a velocity or position.

    Raises:
        ValueError: if a recording lacks something, or there are too few windows.
    """
    layout = Layout() if layout is None else layout
    with jax.enable_x64(True):
        search, windows, root = _search(field, recordings, layout, measured, CANDIDATES * layout.most)
        moves, measurable = _moving(field, free, recordings)
        if (n := min(len(windows.centres), layout.most)) <= moves.sum():
            raise ValueError(f"{recordings[0].name}: {n} windows for {moves.sum()} parameters are too few; record more")
        theta, own, p = jnp.asarray(search.theta), search.still, len(search.theta)
        if len(own) > layout.most:
            kept = _informative(search.equations(theta, own), p, layout.most, moves & measurable)
            search, windows, own = search.part(kept), jax.tree.map(lambda part: part[kept], windows), own[kept]
        options = {"free": moves & measurable, "least": NO_EFFECT, "max_steps": MAX_STEPS, "tolerance": TOLERANCE}
        for _ in range(ROUNDS):
            theta, own, equations, _, status = descend(search.equations, theta, own, **options)
            search = search.weighted(search.errors(theta, own))
            variance = jnp.diagonal(inverses(equations.gram[:, p:, p:]).matrix, axis1=1, axis2=2)
            size = jnp.sqrt(jnp.mean((own**2 + variance)[:, TANGENT:], axis=0))
            spread = jnp.asarray(search.spread)
            search = search._replace(spread=spread.at[:, TANGENT:].set(jnp.where(spread[:, TANGENT:] > 0, size, 0.0)))
            if windows.between.shape[1]:
                search = _whitened(search, theta, own, windows.between, root)
        equations = reduced(search.equations(theta, own), p).equations
        cluster = max(1, min(round(CLUSTER / (layout.dt * layout.steps)), len(own) // FEWEST_CLUSTERS))
        covariance = _covariance(equations, cluster, moves, known, measurable)
        found, last = search.model(theta).field.field, search.errors(theta, own)
        shares = _explained(search, theta, own)
        intervals = uncertainty.intervals(found, covariance, degrees=max(1, -(-len(own) // cluster) - 1))
    errors = {name: np.sqrt(np.mean(each**2, axis=0)) for name, each in last.items()}
    intervals = {name: _widened(name, interval, shares) for name, interval in intervals.items()}
    span = layout.dt * layout.steps * len(own)
    return Identified(in_double(found), intervals, errors, len(own), span, status, np.asarray(covariance), shares)


def _search(
    field, recordings: Sequence[Recording], layout: Layout, measured: Sequence[str], most: int
) -> tuple[Search, Windows, Float[np.ndarray, "m k"]]:
    physics = physics_of(field)
    commanded = isinstance(physics, Actuated)
    volts = commanded and physics.reads_voltage
    for name in (each.name for each in recordings if volts and "voltage" not in each.signals):
        mend = "leave nominal_voltage and voltage_exponent out of [actuator], or leave this log out"
        raise ValueError(f"{name}: has no battery voltage, which the actuator depends on; {mend}")
    motor = "command" if commanded else "rotor_speed"
    windows, axes, root = cut(recordings, layout, motor, measured, most, volts)
    model = in_double(Multirotor(with_hidden(physics, RandomWalk(PUSHED)), axes, layout.ahead))
    scale = {}
    for name, there in windows.segments.there.items():  # the spread of each channel in time
        spread = np.nanstd(np.where(there[..., None], windows.segments.y[name], np.nan), axis=(0, 1, 2))
        scale[name] = jnp.full(3, 0.1) if name == "attitude" else jnp.asarray(np.maximum(spread, 1e-9))
    problem = Problem(model, scale, np.inf, layout.dt, RK4(), 1)
    theta = np.asarray(ravel_learned(model)[0])
    rotors = np.zeros((len(windows.centres), model.rotor_states))
    centres = np.concatenate([windows.centres[:, :STATE_SIZE], rotors, windows.centres[:, STATE_SIZE:]], axis=1)
    unknown = np.full(len(theta), np.inf)
    search = Search(problem, jnp.asarray(centres)[:, None], unknown, theta, windows.segments, windows.spread)
    return search, windows, root


def identify_in_turn(
    field: AbstractVectorField, recordings: Sequence[Recording], layout: Layout | None = None
) -> Identified:
    """Fit first the thrust to the accelerometer, then the torques to the gyro, given the thrust.

    An error in the torques, for example the delay of a filtered gyro, then cannot bias the thrust curve and the lag.
    The second intervals include the uncertainty of the first fit. If one of the fits lacks parameters or a sensor, this
    is `identify`. Windows for the forces are `FORCE_STEPS` times as long.

    Args:
        field: an `Actuated` field if the input is commands; any other field takes the measured rotor speeds.
        recordings: one or more recordings of one vehicle.
        layout: how they are cut into windows for the torques, by default `Layout()`.
    """
    layout = Layout() if layout is None else layout
    theta = {*dict(_names(field))}
    force, torque = tuple(theta & OF_FORCE), tuple(theta - OF_FORCE)
    sensed = all({"specific_force", "rates"} <= each.signals.keys() for each in recordings)
    if not (force and torque and sensed):
        return identify(field, recordings, layout)
    long = replace(layout, steps=layout.steps * FORCE_STEPS, most=max(layout.most // 2, 1), disturbance=(0.0,) * 6)
    first = identify(field, recordings, long, ("specific_force",), free=force)
    second = identify(first.field, recordings, layout, ("rates",), free=torque, known=first.covariance)
    own = {name: value for name, value in first.intervals.items() if name.partition("[")[0] in force}
    both = {"intervals": second.intervals | own, "errors": first.errors | second.errors}
    return second._replace(**both, status=max(first.status, second.status))


@entry
def window_errors(
    field: AbstractVectorField, recordings: Sequence[Recording], layout: Layout | None = None
) -> dict[str, Float[np.ndarray, "n t k"]]:
    """Return y − ŷ of every window, from the state estimated from earlier samples; NaN where there is no y.

    Args:
        field: an `Actuated` field if the input is commands; any other field takes the measured rotor speeds.
        recordings: one or more recordings of one vehicle.
        layout: how they are cut into windows, by default `Layout()`.
    """
    layout = Layout() if layout is None else layout
    with jax.enable_x64(True):
        search, *_ = _search(field, recordings, layout, (), layout.most)
        found = search.predicted(search.theta, search.still).errors
    there = search.segments.there
    return {name: np.where(there[name][:, 0, :, None], -part[:, 0], np.nan) for name, part in found.items()}


def _informative(equations: NormalEquations, p: int, most: int, moves) -> Int[np.ndarray, " most"]:
    """Select the windows to fit: half have the greatest leverage tr G⁻¹ Gᵢ, the others are spread evenly.

    Gᵢ is the information of window i at the start of the search, and G their sum.
    """
    gram = masked(reduced(equations, p).equations, moves).gram
    leverage = jnp.einsum("pq,nqp->n", inverse(jnp.sum(gram, axis=0)).matrix, gram)
    order = np.argsort(-np.asarray(leverage), kind="stable")
    others = np.sort(order[most // 2 :])
    even = others[np.linspace(0, len(others) - 1, most - most // 2).round().astype(int)]
    return np.sort(np.concatenate([order[: most // 2], even]))


def _whitened(search: Search, theta, own, between, root) -> Search:
    segments, (scale, dt) = search.segments._replace(whitening=None), (search.problem.scale, search.problem.dt)
    ways = slow_commands.bridges(between, dt * np.arange(segments.u.shape[2] + 1), root)
    r, along = effects(search.problem, search.model(theta), search.nodes(own)[0][:, 0], segments, ways)
    names, steps = sorted(scale), segments.valid.shape[2]
    parts = np.split(np.arange(r.shape[1]), np.cumsum([steps * len(scale[name]) for name in names])[:-1])
    there, channel, first = np.zeros(r.shape, bool), np.zeros(r.shape[1], int), 0
    for name, part in zip(names, parts, strict=True):
        k = len(scale[name])
        there[:, part] = np.repeat(segments.there[name][:, 0], k, axis=1)
        channel[part], first = first + np.tile(np.arange(k), steps), first + k
    noise, whitening = slow_commands.whitened(np.asarray(r), np.asarray(along), there, channel)
    scale = {name: scale[name] * noise[np.unique(channel[part])] for name, part in zip(names, parts, strict=True)}
    problem = replace(search.problem, scale=scale)
    return search._replace(problem=problem, segments=segments._replace(whitening=whitening[:, None]))


def _explained(search: Search, theta, own) -> np.ndarray:
    """Return R² of each body rate over a window, beyond its start and a constant acceleration; else 1."""
    if "rates" not in search.segments.y:
        return np.ones(3)
    error, y = np.asarray(search.predicted(theta, own).errors["rates"])[:, 0], search.segments.y["rates"][:, 0]
    basis, _ = np.linalg.qr(np.arange(error.shape[1])[:, None] ** np.arange(2.0))
    both = error, np.where(search.segments.there["rates"][:, 0, :, None], y, 0.0)
    parts = [((part - basis @ (basis.T @ part)) ** 2).sum(axis=(0, 1)) for part in both]
    shares = np.ones(3)
    shares[list(search.problem.model.axes["rates"])] = 1 - parts[0] / np.maximum(parts[1], 1e-300)
    return np.clip(shares, 0.0, 1.0)


def _widened(name: str, interval: Interval, shares) -> Interval:
    """Widen an interval to both regressions, of torque on acceleration and the inverse (Klepper and Leamer 1984)."""
    value, low, high = map(np.asarray, interval)
    share = np.asarray(shares[AXES_OF[name]]) if name in AXES_OF else np.ones(())
    return Interval(value, low * share, np.divide(high, share, out=np.full((), np.inf), where=share > 0))


def measure_velocity(recordings: Sequence[Recording]) -> bool:
    """Return whether each recording has a velocity or a position."""
    return all({"velocity", "body_velocity", "position"} & each.signals.keys() for each in recordings)


def _names(field) -> list[tuple[str, str]]:
    physics = physics_of(field)
    leaves = jax.tree_util.tree_flatten_with_path(eqx.filter(physics, trainable(physics)))[0]
    named = [(jax.tree_util.keystr(path[-1:], simple=True), leaf.size) for path, leaf in leaves]
    return [(name, f"{name}[{i}]") for name, size in named for i in range(size)]


def _moving(field, free: Sequence[str] | None, recordings: Sequence[Recording]) -> tuple[np.ndarray, np.ndarray]:
    """Return which numbers of θ are to be fitted, and which can be: effects of velocity only if it is measured."""
    own = _names(field)
    for name in free or ():
        if name.partition("[")[0] not in dict(own):
            raise ValueError(f"free must be among {', '.join(dict(own))}, got {name!r}")
    known = measure_velocity(recordings)
    moves = [free is None or not {*names}.isdisjoint(free) for names in own]
    return np.array(moves, bool), np.array([known or name not in OF_VELOCITY for name, _ in own], bool)


def _covariance(equations: NormalEquations, cluster: int, moves, known, measurable) -> Array:
    """Return the clustered sandwich plus S C Sᵀ for known parameters, S = −H⁻¹ ∂g/∂known; ∞ if not identifiable."""
    gram = np.asarray(equations.gram.sum(axis=0))
    seen = (np.diagonal(gram) > NO_EFFECT) & moves & measurable
    found, both = np.zeros_like(gram), np.ix_(seen, seen)
    found[both] = np.asarray(uncertainty.sandwich(masked(equations, seen), int(seen.sum()), cluster))[both]
    if known is not None:
        fixed = ~moves & np.isfinite(np.diagonal(known))
        slope = np.linalg.lstsq(gram[both], gram[np.ix_(seen, fixed)], rcond=1e-12)[0]
        found[both] += slope @ known[np.ix_(fixed, fixed)] @ slope.T
        found += np.where(moves[:, None] | moves, 0.0, known)
    return jnp.asarray(found + np.diag(np.where(~seen & moves, np.inf, 0.0)))
