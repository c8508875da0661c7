"""Identify a vehicle from recordings of commands and of whatever was measured, through the ODE solver.

The measurements of each window are compared with those that the field predicts from the window's initial state, which
is unknown, too: it enters with the estimate of `recordings.initial_states` as a prior (an arrival cost; Rao, Rawlings
and Mayne 2003). So does a force and a torque that is constant over a window: wind, a battery that sags, and other slow
errors that a pilot corrects, which would pass for effects of the commands. Both are eliminated window by window from
the normal equations of the parameters (multiple shooting; Bock 1983). Levenberg–Marquardt takes the steps. In rounds
each channel is weighted by its own errors, and the disturbances get the variance that they turn out to have (empirical
Bayes by expectation maximisation; Dempster, Laird and Rubin 1977).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.actuators import Actuated
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.dynamics.disturbance import physics_of
from hybrid_jax.estimation import uncertainty
from hybrid_jax.estimation.elimination import descend, reduced
from hybrid_jax.estimation.least_squares import in_double, ravel_parameters
from hybrid_jax.estimation.normal_equations import NormalEquations, inverse, inverses, masked
from hybrid_jax.estimation.uncertainty import Interval
from hybrid_jax.flights.recording import Recording
from hybrid_jax.identification import slow_commands
from hybrid_jax.identification.prediction_error import (
    TANGENT,
    Problem,
    all_errors,
    normal_equations,
    rms,
    slopes_between,
)
from hybrid_jax.identification.recordings import Layout, Windows, cut
from hybrid_jax.runtime import entry
from hybrid_jax.status import Status

ROUNDS = 3  # of weights
CANDIDATES = 8  # windows for each one that is fitted
CLUSTER = 2.0  # s of windows that are taken as one observation,
FEWEST_CLUSTERS = 6  # of which there are so many, though, if there are as many windows
OF_FORCE = {"curve", "time_constant", "time_constants", "voltage_exponent", "mass", "k", "k_rotors", "drag"}
OF_VELOCITY = {"drag", "aerodynamic_moment", "velocity_lag", "velocity_gain"}
FORCE_STEPS = 5  # times as many steps have windows of forces, which no instability limits
AXES_OF = {"Ix": 0, "Iy": 1, "Iz": 2, "torque_coefficient": 2}
TOLERANCE = 1e-5  # share of the cost: a step that lowers it by less is slow
NO_EFFECT = 1.0  # information of a parameter that is not told: its standard error is its own size, or a factor of e


class Identified(NamedTuple):
    """The result of `identify`.

    Attributes:
        field: with the fitted parameters.
        intervals: confidence interval of each parameter, number by number, by default of 95 %.
        errors: RMS of each quantity's channels over the windows, from the estimated initial states.
        windows: how many were fitted.
        seconds: length of all windows [s].
        status: how the last round ended.
        covariance: of the parameters (p, p), in the parametrisation of `ravel_parameters`.
        explained: share of the change of each body rate in a window that is told (3); 1 if not measured.
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
        """Whether the last round stopped by itself, where no step lowers the errors further."""
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
    rounds: int = ROUNDS,
    max_steps: int = 20,
    level: float = 0.95,
) -> Identified:
    """Fit the learned parameters of the field's physics to recordings.

    Args:
        field: an `Actuated` field, told commands; any other is told the measured rotor speeds.
        recordings: of one vehicle; one or more.
        layout: how they are cut into windows, by default `Layout()`.
        measured: quantities that are compared, by default all that every recording has.
        free: names of parameters that are fitted, such as k or efficiency[2], by default all; the others stay.
        known: the covariance of those that stay, to which the fitted ones owe a part of theirs; by default zero.
        rounds: fits, each with channels weighted by the errors of the one before.
        max_steps: of Levenberg–Marquardt in each round.
        level: confidence of the intervals, between 0 and 1.

    Returns:
        A parameter that the windows do not tell has an infinite interval and stays as it was, as do those of
        `OF_VELOCITY` where no recording holds a velocity or position.

    Raises:
        ValueError: of a recording that lacks something, or too few windows: name and what was expected.
    """
    layout = Layout() if layout is None else layout
    physics = physics_of(field)
    told = "command" if isinstance(physics, Actuated) else "rotor_speed"
    checks.count("rounds", rounds)
    if isinstance(physics, Actuated) and physics.reads_voltage:
        _require_voltage(recordings)
    windows, inputs, columns = cut(recordings, layout, told, measured, CANDIDATES * layout.most)
    moves, measurable = _free(field, free), _measurable(field, recordings)
    if (n := min(len(windows.start), layout.most)) <= moves.sum():
        raise ValueError(f"{recordings[0].name}: {n} windows for {moves.sum()} parameters; record more")
    with jax.enable_x64(True):
        field = in_double(field)
        theta, unravel = ravel_parameters(field)
        spread = jnp.concatenate([windows.spread, np.tile(layout.disturbance, (len(windows.start), 1))], axis=1)
        problem = Problem(windows, inputs, columns, {name: _first_scale(windows, name) for name in columns}, spread)
        if len(windows.start) > layout.most:
            problem = _telling(field, problem, layout, theta, moves & measurable)
        windows, spread = problem.windows, problem.spread
        changes, status, errors = jnp.zeros_like(spread), Status.RUNNING, {}
        for _ in range(rounds):
            linearised = partial(normal_equations, field, problem, layout)
            options = {"free": moves & measurable, "least": NO_EFFECT, "max_steps": max_steps, "tolerance": TOLERANCE}
            theta, changes, equations, _, status = descend(linearised, theta, changes, **options)
            errors = {name: np.asarray(size) for name, size in rms(field, theta, changes, problem, layout).items()}
            variance = jnp.diagonal(inverses(equations.gram[:, len(theta) :, len(theta) :]).matrix, axis1=1, axis2=2)
            size = jnp.sqrt(jnp.mean((changes**2 + variance)[:, TANGENT:], axis=0))
            spread = spread.at[:, TANGENT:].set(jnp.where(spread[:, TANGENT:] > 0, size, 0.0))
            scale = {name: jnp.maximum(errors[name], 1e-9) for name in columns}
            problem = problem._replace(scale=scale, spread=spread)
            if windows.between.shape[1]:
                problem = _weighted(field, theta, changes, problem, layout)
        equations = reduced(normal_equations(field, problem, layout, theta, changes), len(theta)).equations
        cluster = max(1, min(round(CLUSTER / (layout.dt * layout.steps)), len(windows.start) // FEWEST_CLUSTERS))
        covariance = _covariance(equations, cluster, moves, known, measurable)
        degrees = max(1, -(-len(windows.start) // cluster) - 1)
        found = unravel(theta)
        intervals = uncertainty.intervals(found, covariance, level, degrees)
        shares = _explained(field, theta, changes, problem, layout) if "rates" in columns else np.ones(3)
        intervals = {name: _widened(name, interval, shares) for name, interval in intervals.items()}
    span = layout.dt * layout.steps * len(windows.start)
    return Identified(found, intervals, errors, len(windows.start), span, status, np.asarray(covariance), shares)


def identify_in_turn(
    field: AbstractVectorField, recordings: Sequence[Recording], layout: Layout | None = None
) -> Identified:
    """First what makes the thrust, from the accelerometer; then, given that, what turns the vehicle, from the gyro.

    An error of the torques, such as the delay of a filtered gyro, then cannot bend the thrust curve and the lag.
    Windows of forces are `FORCE_STEPS` times as long. The result has the intervals of both; the second ones hold the
    uncertainty of the first. For errors see `identify`, which does all at once where one of the two has no parameter or
    no sensor.

    Args:
        field: an `Actuated` field, told commands; any other is told the measured rotor speeds.
        recordings: of one vehicle; one or more.
        layout: how they are cut into windows of torques, by default `Layout()`.
    """
    layout = Layout() if layout is None else layout
    theta = {*dict(_numbers(field))}
    force, torque = tuple(theta & OF_FORCE), tuple(theta - OF_FORCE)
    signals = [each.signals.keys() for each in recordings]
    if not force or not torque or not all({"specific_force", "rates"} <= each for each in signals):
        return identify(field, recordings, layout)
    long = replace(layout, steps=layout.steps * FORCE_STEPS, most=max(layout.most // 2, 1), disturbance=(0.0,) * 6)
    first = identify(field, recordings, long, ("specific_force",), free=force)
    second = identify(first.field, recordings, layout, ("rates",), free=torque, known=first.covariance)
    own = {name: value for name, value in first.intervals.items() if name.partition("[")[0] in force}
    return second._replace(
        intervals=second.intervals | own,
        errors=first.errors | second.errors,
        status=max(first.status, second.status),
    )


@entry
def prediction_errors(
    field: AbstractVectorField,
    recordings: Sequence[Recording],
    layout: Layout | None = None,
    measured: Sequence[str] = (),
) -> dict[str, Float[np.ndarray, "n t k"]]:
    """y − ŷ of every window, predicted from the state that the samples before it tell; NaN where there is no y.

    Args:
        field: an `Actuated` field, told commands; any other is told the measured rotor speeds.
        recordings: of one vehicle; one or more.
        layout: how they are cut into windows, by default `Layout()`.
        measured: quantities that are compared, by default all that every recording has.
    """
    layout = Layout() if layout is None else layout
    told = "command" if isinstance(physics_of(field), Actuated) else "rotor_speed"
    windows, inputs, columns = cut(recordings, layout, told, measured, layout.most)
    with jax.enable_x64(True):
        field = in_double(field)
        problem = Problem(windows, inputs, columns, {name: jnp.ones(1) for name in columns}, jnp.zeros(()))
        zero = jnp.zeros((len(windows.start), TANGENT + 6))
        found = all_errors(field, ravel_parameters(field)[0], zero, problem, layout)
    return {name: np.where(windows.there[name][..., None], np.asarray(part), np.nan) for name, part in found.items()}


def _telling(field, problem: Problem, layout: Layout, theta, moves) -> Problem:
    """The problem with fewer windows: half of them tell most of the parameters, the others are spread evenly.

    Most is told by those of greatest leverage tr G⁻¹ Gᵢ, where Gᵢ is what a window tells at the start of the search,
    and G what all of them do. So a few seconds that alone tell a parameter are among them. What was measured has no
    part in it. The other half stands for the whole, which a model that is wrong somewhere should fit on average.
    """
    equations = normal_equations(field, problem, layout, theta, jnp.zeros_like(problem.spread))
    gram = masked(reduced(equations, len(theta)).equations, moves).gram
    leverage = jnp.einsum("pq,nqp->n", inverse(jnp.sum(gram, axis=0)).matrix, gram)
    order, most = np.argsort(-np.asarray(leverage), kind="stable"), layout.most // 2
    others = np.sort(order[most:])
    even = others[np.linspace(0, len(others) - 1, layout.most - most).round().astype(int)]
    kept = np.sort(np.concatenate([order[:most], even]))
    return problem._replace(windows=jax.tree.map(lambda part: part[kept], problem.windows), spread=problem.spread[kept])


def _weighted(field, theta, changes, problem: Problem, layout: Layout) -> Problem:
    """The problem with errors weighted by what commands may have done between their samples."""
    at = field, theta, changes, problem, layout
    scale, whitening = slow_commands.whitened(
        all_errors(*at), slopes_between(*at), problem.windows.there, problem.scale
    )
    return problem._replace(scale={name: jnp.asarray(each) for name, each in scale.items()}, whitening=whitening)


def _explained(field, theta, changes, problem: Problem, layout: Layout) -> np.ndarray:
    """R² of each body rate over a window, of what is neither its start nor a constant acceleration."""
    there = problem.windows.there["rates"][..., None]
    error = np.asarray(all_errors(field, theta, changes, problem, layout)["rates"])
    basis, _ = np.linalg.qr(np.arange(layout.steps)[:, None] ** np.arange(2.0))
    both = error, np.where(there, problem.windows.y["rates"], 0.0)
    parts = [((part - basis @ (basis.T @ part)) ** 2).sum(axis=(0, 1)) for part in both]
    shares = np.ones(3)
    shares[list(problem.columns["rates"])] = 1 - parts[0] / np.maximum(parts[1], 1e-300)
    return np.clip(shares, 0.0, 1.0)


def _widened(name: str, interval: Interval, shares) -> Interval:
    """An interval that holds both regressions, of torque on acceleration and the other way round.

    Noise in the one that explains shrinks a coefficient, to R² of the other at most (Frisch 1934; Klepper and Leamer
    1984). Which of the two is right a log does not say, as commands follow from what was measured.
    """
    value, low, high = map(np.asarray, interval)
    share = np.asarray(shares[AXES_OF[name]]) if name in AXES_OF else np.ones(())
    return Interval(value, low * share, np.divide(high, share, out=np.full((), np.inf), where=share > 0))


def _first_scale(windows: Windows, name: str) -> Array:
    """The spread of each channel in time, before anything is fitted."""
    if name == "attitude":
        return jnp.full(3, 0.1)
    spread = np.nanstd(np.where(windows.there[name][..., None], windows.y[name], np.nan), axis=(0, 1))
    return jnp.asarray(np.maximum(spread, 1e-9))


def _numbers(field) -> list[tuple[str, int]]:
    """The parameter that each number of θ belongs to, and its place in that."""
    physics = physics_of(field)
    leaves = jax.tree_util.tree_flatten_with_path(eqx.filter(physics, trainable(physics)))[0]
    return [(jax.tree_util.keystr(path[-1:], simple=True), i) for path, leaf in leaves for i in range(leaf.size)]


def _require_voltage(recordings: Sequence[Recording]) -> None:
    for recording in recordings:
        if "voltage" not in recording.signals:
            mend = "leave nominal_voltage and voltage_exponent out of [actuator], or leave this log out"
            raise ValueError(f"{recording.name}: has no battery voltage, which the actuator depends on; {mend}")


def _free(field, names: Sequence[str] | None) -> np.ndarray:
    """Which numbers of θ belong to the named parameters; ValueError for a name that the field does not learn."""
    own = _numbers(field)
    for name in names or ():
        if name.partition("[")[0] not in dict(own):
            raise ValueError(f"free must be of {', '.join(dict(own))}, got {name!r}")
    return np.array([names is None or not {name, f"{name}[{i}]"}.isdisjoint(names) for name, i in own], bool)


def _measurable(field, recordings: Sequence[Recording]) -> np.ndarray:
    """Which numbers of θ are not of a velocity that no recording measures: the windows would tell them by chance."""
    measured = {"velocity", "body_velocity", "position"}
    known = all(measured & each.signals.keys() for each in recordings)
    return np.array([known or name not in OF_VELOCITY for name, _ in _numbers(field)], bool)


def _covariance(equations: NormalEquations, cluster: int, moves, known, measurable) -> Array:
    """The sandwich of `uncertainty`, with windows clustered; infinite for what has no effect.

    To it comes what follows from the uncertainty of known parameters: S C Sᵀ with S = −H⁻¹ ∂g/∂known (delta method).
    """
    gram = np.asarray(equations.gram.sum(axis=0))
    seen = (np.diagonal(gram) > NO_EFFECT) & moves & measurable
    found = np.zeros_like(gram)
    both = np.ix_(seen, seen)
    found[both] = np.asarray(uncertainty.sandwich(masked(equations, seen), int(seen.sum()), cluster))[both]
    if known is not None:
        fixed = ~moves & np.isfinite(np.diagonal(known))
        slope = np.linalg.lstsq(gram[both], gram[np.ix_(seen, fixed)], rcond=1e-12)[0]
        found[both] += slope @ known[np.ix_(fixed, fixed)] @ slope.T
        found += np.where(moves[:, None] | moves, 0.0, known)
    return jnp.asarray(found + np.diag(np.where(~seen & moves, np.inf, 0.0)))
