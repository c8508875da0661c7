"""D-optimal references or inputs within limits, which minimise the confidence ellipsoid of the parameters.

See Fedorov, Theory of Optimal Experiments, 1972; Mehra, IEEE TAC 1974; and for Fourier series Swevers et al. 1997.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, as_field, parts_of, state_space
from hybrid_jax.dynamics.disturbance import sized
from hybrid_jax.dynamics.hidden import DisturbanceModel
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE, RigidBody
from hybrid_jax.estimation.least_squares import ravel_parameters, rounding
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.planning.fisher_information import Information, information_of, noise_of
from hybrid_jax.planning.input_designs import (
    RAMP,
    Coefficients,
    Design,
    FlatOutputs,
    FlightBounds,
    InputBounds,
    InputSeries,
    Trajectory,
)
from hybrid_jax.runtime import FAST_COMPILE, entry
from hybrid_jax.trajectories import windows_of
from hybrid_jax.vehicle import STATE_SIZE

SPARE = 0.98  # largest used share of each limit, since limits are checked at samples only
SHRUNK = 1 - np.arange(64) / 64  # factors on a series; the first that satisfies the limits is used
PENALTY = 30.0, 3000.0  # on the mean squared excess over a limit, at the first and at the last step
DISTINCT = 1e-5  # smallest eigenvalue of the scaled information, ten times its rounding in float32
RATE = 0.05  # of Adam, in units of the coefficients
Starts = Float[Array, "s outputs harmonics 2"]


@dataclass(frozen=True)
class Excitation:
    """The result of `excitation`: a plan of n intervals.

    Attributes:
        reference: a function of time t [s] that returns position [m] and yaw [rad] of a multirotor, else the inputs.
        t: the times (n + 1,) of the states [s], from 0.
        states: the planned states (n + 1, d) at these times.
        inputs: the planned inputs (n, m), each held over an interval; rotor speeds [rad/s] for a multirotor.
        parameters: the names of the q requested parameters that the inputs excite.
        information: their inverse covariance (q, q) in the physics' own parametrisation, with the others unknown.
        standard_errors: the predicted standard error of each requested parameter, in the units of `intervals`; infinite
            if the inputs do not excite it.
        margins: the unused fraction of each limit, by the limit's name; 0 if all of it is used.
    """

    reference: Callable[..., Any]
    t: Float[np.ndarray, " n+1"]
    states: Float[np.ndarray, "n+1 d"]
    inputs: Float[np.ndarray, "n m"]
    parameters: tuple[str, ...]
    information: Float[np.ndarray, "q q"]
    standard_errors: dict[str, float]
    margins: dict[str, float]

    @property
    def log_det(self) -> float:
        """log det of the information, which a D-optimal design maximises."""
        return float(np.linalg.slogdet(self.information)[1])


@entry
def excitation(
    model: AbstractVectorField,
    parameters: Sequence[str] | None,
    bounds: FlightBounds | InputBounds,
    key: PRNGKeyArray,
    *,
    seconds: float = 10.0,
    noise: Sequence[float] | None = None,
    window: float = 0.1,
    dt: float = 0.01,
    bandwidth: float = 2.0,
    starts: int = 4,
    steps: int = 200,
) -> Excitation:
    """Design the flight, or the inputs, from which you learn most about parameters.

    It maximises log det of the inverse covariance of `parameters` that `fit_least_squares(…, scale=noise)` will have on
    windows of the flight. All other parameters of the physics count as unknown as well, for example a constant force
    and torque with `with_disturbance(model)`. Adam improves random series. A series outside the limits is shrunk, so
    the result satisfies them and is at least as informative as any start. Note that the standard errors are predicted
    for the plan, which the vehicle will not follow exactly.

    Hidden states count as unmeasured, and unknown at the start of each window. For a model from `fit_disturbance`, the
    parameters are those of its field, with a disturbance that is as large and lasts as long as in its data.

    Args:
        model: any field with a guess of its parameters: a multirotor with `FlightBounds`, another with `InputBounds`.
        parameters: names as in `intervals`; by default all except a disturbance.
        bounds: the limits of the plan. You should leave room, since the vehicle follows it with an error.
        key: random key of the initial series.
        seconds: the duration of the plan [s].
        noise: the standard deviation of the white noise of each state that is not hidden; for a multirotor by default
            as in motion capture.
        window: the length of the windows [s], a multiple of `dt`.
        dt: the interval between samples, over which an input is held [s].
        bandwidth: the highest frequency of the series [Hz].
        starts: the number of random series to start from; you get the best result.
        steps: the number of steps of Adam.

    Raises:
        ValueError: if a parameter is unknown, bounds are of the wrong kind, the vehicle at rest violates them, or no
            start distinguishes the parameters. You get a warning with the name of a parameter that no input excites.
    """
    past = model if isinstance(model, DisturbanceModel) else None
    design = _design(model if past is None else past.field, bounds, seconds, window, dt, bandwidth)
    for name, value in (("starts", starts), ("steps", steps)):
        checks.count(name, value, least=int(name == "starts"))
    checks.key("key", key)
    states = STATE_SIZE if isinstance(design, FlatOutputs) else len(bounds.start)  # pyright: ignore
    model = sized(model if past is None else past.field, states)
    wanted, measured = _wanted(model, parameters), states - as_field(model).hidden
    search = coarse = _Search(design, model, jnp.asarray(noise_of(noise, measured)), round(window / dt), past)
    if search.window % 2 == 0:
        coarse = replace(search, design=replace(design, dt=2 * dt), window=search.window // 2)
    begun = _begun(search, starts, key)
    asked, seen = _excited(search, begun, wanted)
    found = jnp.concatenate([begun, coarse.improved(begun, asked, seen, steps)])
    found = jnp.where(jnp.isfinite(found), found, 0.0)
    best = search.kept(found[jnp.argmax(search.values(found, asked, seen))])
    return _result(search, best, wanted, asked, seen)


class _Search(eqx.Module):
    design: Design
    model: AbstractVectorField
    noise: Float[Array, " s"]
    window: int = eqx.field(static=True)
    past: DisturbanceModel | None

    @eqx.filter_jit
    def planned(self, coefficients: Coefficients) -> Trajectory:
        return self.design.trajectory(coefficients, self.model)

    @eqx.filter_jit
    def information(self, x: Float[Array, "n+1 d"], u: Float[Array, "n m"]) -> Information:
        return information_of(self.model, x, u, self.design.dt, self.window, self.noise, past=self.past)

    def value(self, x, u, asked: Bool[Array, " p"], seen: Bool[Array, " p"]) -> Float[Array, ""]:
        covariance = self.information(x, u).covariance(seen)
        size = jnp.sqrt(jnp.where(asked, jnp.diagonal(covariance), 1.0))
        scaled = jnp.where(asked & asked[:, None], covariance / (size * size[:, None]), jnp.eye(len(size)))
        return -(jnp.linalg.slogdet(scaled)[1] + 2 * jnp.sum(jnp.log(size))) / jnp.sum(asked)

    @eqx.filter_jit
    def kept(self, coefficients: Coefficients) -> Coefficients:
        def keeps(factor):
            uses = self.design.uses(*self.planned(factor * coefficients))
            return (uses <= SPARE).all()

        inside = jax.lax.map(keeps, jnp.asarray(SHRUNK, coefficients.dtype))
        return jnp.where(inside.any(), jnp.asarray(SHRUNK)[jnp.argmax(inside)], 0.0) * coefficients

    @eqx.filter_jit
    def values(self, found: Starts, asked, seen) -> Float[Array, " s"]:
        """Return the information of each series within the limits, −∞ if not finite."""

        def one(coefficients):
            value = self.value(*self.planned(self.kept(coefficients)), asked, seen)
            return jnp.where(jnp.isfinite(value), value, -jnp.inf)

        return jax.lax.map(one, found)

    # Equinox passes the options to jax.jit, but does not declare them.
    @eqx.filter_jit(compiler_options=FAST_COMPILE)  # pyright: ignore[reportCallIssue]
    def improved(self, begun: Starts, asked, seen, steps: int) -> Starts:
        def loss(coefficients, penalty):
            x, u = self.planned(coefficients)
            excess = jnp.maximum(self.design.uses(x, u) - SPARE, 0.0)
            return penalty * jnp.sum(jnp.mean(jnp.square(excess), axis=0)) - self.value(x, u, asked, seen)

        adam = optax.chain(optax.zero_nans(), optax.adam(optax.cosine_decay_schedule(RATE, max(steps, 1))))

        def step(carry, penalty):
            coefficients, state = carry
            slopes = jax.vmap(jax.grad(loss), in_axes=(0, None))(coefficients, penalty)
            changes, state = adam.update(slopes, state)
            return (coefficients + changes, state), None

        return jax.lax.scan(step, (begun, adam.init(begun)), jnp.geomspace(*PENALTY, steps))[0][0]


def _design(model, bounds, seconds: float, window: float, dt: float, bandwidth: float) -> Design:
    for name, value in (("seconds", seconds), ("window", window), ("dt", dt), ("bandwidth", bandwidth)):
        checks.positive(name, value)
    if isinstance(bounds, FlightBounds) and seconds < 2 * RAMP:
        raise ValueError(f"seconds must be at least {2 * RAMP:g}, as a flight starts and ends in hover, got {seconds}")
    if abs(round(window / dt) * dt - window) > 1e-6 * window or not window <= seconds:
        raise ValueError(f"window must be a multiple of dt {dt} and at most seconds {seconds}, got {window}")
    if not 1 / seconds <= bandwidth <= 0.5 / dt:
        raise ValueError(f"bandwidth must be from {1 / seconds:.3g} to {0.5 / dt:.3g} Hz, got {bandwidth}")
    numbers = seconds, math.floor(bandwidth * seconds + 1e-9), dt
    if isinstance(bounds, InputBounds):
        return InputSeries(bounds, *numbers)
    if not isinstance(bounds, FlightBounds):
        raise ValueError(f"bounds must be FlightBounds or InputBounds, got {checks.short_repr(bounds)}")
    bodies = [part for part in parts_of(model) if isinstance(part, RigidBody)]
    if not bodies or state_space(model) != RIGID_BODY_SPACE:
        raise ValueError("bounds must be InputBounds, as the model is not a multirotor with rotor speeds as inputs")
    vehicle = bodies[0].vehicle
    least, most = bounds.rotor_speed
    if not least < vehicle.hover_speed / vehicle.max_rotor_speed < most or vehicle.rotors < 4:
        share = vehicle.hover_speed / vehicle.max_rotor_speed
        raise ValueError(
            f"rotor_speed must allow hover, a share of {share:.2g}, on four rotors or more; got {bounds.rotor_speed}"
        )
    return FlatOutputs(vehicle, bounds, *numbers)


def _wanted(model: AbstractVectorField, parameters: Sequence[str] | None) -> tuple[str, ...]:
    known = named_parameters(model)
    if parameters is None:
        return tuple(name for name in known if not name.startswith("disturbance["))
    if isinstance(parameters, str) or not parameters or not set(parameters) <= set(known):
        raise ValueError(f"parameters must be names of {', '.join(known)}, got {checks.short_repr(parameters)}")
    return tuple(dict.fromkeys(parameters))


def _begun(search: _Search, starts: int, key: PRNGKeyArray) -> Starts:
    rest = jnp.zeros(search.design.shape)
    uses = np.asarray(search.design.uses(*search.planned(rest))).max(axis=0, initial=0.0)
    for name, use in zip(search.design.names, uses, strict=True):
        if not use <= SPARE:
            raise ValueError(f"bounds: {name} leaves its limits even at rest, with mid-range inputs; widen its limits")
    draws = jax.random.normal(key, (starts, *search.design.shape))
    return jax.lax.map(search.kept, draws / math.sqrt(search.design.harmonics))


def _excited(search: _Search, begun, wanted: tuple[str, ...]) -> tuple[Bool[Array, " p"], Bool[Array, " p"]]:
    """Return which parameters are requested and which have an effect; warn about those that are not both."""
    names = list(named_parameters(search.model))
    found = [search.planned(one) for one in begun]
    each = [search.information(*flown) for flown in found]
    gram = np.max([np.diagonal(one.gram) for one in each], axis=0)
    x, u = (np.asarray(part) for part in found[0])
    windows = windows_of(x[:, : len(search.noise)], u, search.design.dt, steps=search.window)
    seen = jnp.asarray(gram > float(rounding(windows, search.noise)) ** 2)
    for name in (name for name, known in zip(names, seen, strict=True) if not known):
        checks.warn(f"excitation: no input excites {name}; it is left out")
    asked = jnp.asarray([name in wanted for name in names]) & seen
    if not asked.any():
        raise ValueError(f"parameters: no input excites any of {', '.join(wanted)}")
    grams = np.stack([np.where(np.outer(seen, seen), one.gram, np.diag(np.where(seen, 0.0, 1.0))) for one in each])
    sizes = np.sqrt(np.diagonal(grams, axis1=1, axis2=2))
    values, vectors = np.linalg.eigh(grams / (sizes[:, :, None] * sizes[:, None]))
    if not (values[:, 0] > DISTINCT).any():
        alike = [name for name, share in zip(names, np.abs(vectors[0, :, 0]), strict=True) if share > 0.3]
        raise ValueError(f"parameters: no input distinguishes {' and '.join(alike)}; learn one of them")
    return asked, seen


def _result(search: _Search, best: Coefficients, wanted: tuple[str, ...], asked, seen) -> Excitation:
    design, names = search.design, list(named_parameters(search.model))
    x, u = search.planned(best)
    covariance = np.asarray(search.information(x, u).covariance(seen), float)
    theta, unravel = ravel_parameters(search.model)
    slopes = jax.jvp(lambda theta: named_parameters(unravel(theta)), (theta,), (jnp.ones_like(theta),))[1]
    own = np.flatnonzero(asked)
    sizes = np.sqrt(np.diagonal(covariance)).tolist()
    errors = dict.fromkeys(wanted, math.inf) | {names[i]: abs(float(slopes[names[i]])) * sizes[i] for i in own}
    left = 1 - np.asarray(design.uses(x, u)).max(axis=0, initial=0.0)
    return Excitation(
        reference=design.path(best),
        t=design.dt * np.arange(len(x)),
        states=np.asarray(x),
        inputs=np.asarray(u),
        parameters=tuple(names[i] for i in own),
        information=np.linalg.inv(covariance[np.ix_(own, own)]),
        standard_errors=errors,
        margins=dict(zip(design.names, left.tolist(), strict=True)),
    )
