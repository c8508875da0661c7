"""Actuators: a static curve from motor command to rotor speed, which depends on the battery voltage, and a lag.

    w∞ = W(c (V / V₀)^γ),   τ ẇ = w∞ − w,   τ = τ_up where the rotor speeds up, τ_down where it slows down

c is the command as a fraction of the largest, V the voltage [V]. W is a polynomial that gives the speed [rad/s], or
W = √(f / k) with a polynomial f for the thrust [N] of a rotor and the vehicle's nominal k. The voltage exponent γ is 0
for a vehicle that compensates for its battery voltage, and near 1 for one that does not.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.checks import Numbers
from hybrid_jax.dynamics.base import AbstractVectorField, as_field
from hybrid_jax.dynamics.hidden import AbstractHidden
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE, RigidBody
from hybrid_jax.state_space import Quantity
from hybrid_jax.vehicle import STATE_SIZE, as_tuple, require_numbers

NAMES = ("curve", "time_constant", "time_constants", "voltage_exponent", "delay")  # of learnable parameters
GIVES = ("speed", "thrust")
UNITS = {"time_constant": "s", "time_constants": "s", "delay": "s"}
EXCLUSIVE = {"curve": ("mass", "k", "k_rotors"), "time_constants": ("time_constant",)}
SLOWEST_SHARE = 1e-3  # of the speed of hover; without this limit, the root of a thrust has no slope at zero
QUICKEST = 1e-3  # s, shortest time constant that is learned
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)  # on [-1, 1]; the mean over an interval is good to 1e-4 if τ > Δ/10


@dataclass(frozen=True)
class Actuator:
    """The map from command to rotor speed: the table `[actuator]` of a vehicle file. ValueError if a field is invalid.

    Attributes:
        curve: coefficients c0, c1, … of the polynomial Σ ci command^i, in the unit of `gives`.
        gives: whether the curve gives the "speed" of a rotor [rad/s] or its "thrust" [N].
        time_constants: τ_up and τ_down, for speeding up and slowing down [s]; you can give one number for both.
        nominal_voltage: V₀, the battery voltage at which the curve is valid [V]; 0 if the voltage does not matter.
        voltage_exponent: γ. It should be 0 if the vehicle compensates for its voltage, and else near 1.
        delay: the time between logging a command and its effect [s], constant over a log.
    """

    curve: tuple[float, ...]
    gives: str = "speed"
    time_constants: tuple[float, float] = (0.0, 0.0)
    nominal_voltage: float = 0.0
    voltage_exponent: float = 0.0
    delay: float = 0.0

    def __post_init__(self):
        if not isinstance(self.curve, tuple) or not 2 <= len(self.curve) <= 6:
            raise ValueError(f"curve must be two to six coefficients c0, c1, …, got {checks.short_repr(self.curve)}")
        require_numbers("curve", self.curve, (len(self.curve),), "finite coefficients c0, c1, …")
        if not any(self.curve):
            raise ValueError("curve must have a coefficient that is not zero")
        if self.gives not in GIVES:
            raise ValueError(f"gives must be one of {', '.join(GIVES)}, got {checks.short_repr(self.gives)}")
        if isinstance(self.time_constants, int | float):
            object.__setattr__(self, "time_constants", (float(self.time_constants),) * 2)
        require_numbers("time_constants", self.time_constants, (2,), "one or two numbers of seconds, up and down")
        if min(self.time_constants) < 0 or min(self.time_constants) == 0 < max(self.time_constants):
            raise ValueError(f"time_constants must both be positive, or both 0, got {self.time_constants}")
        checks.not_negative("nominal_voltage", self.nominal_voltage)
        for name in ("voltage_exponent", "delay"):
            require_numbers(name, getattr(self, name), (), "a finite number")
        if self.voltage_exponent and not self.nominal_voltage:
            raise ValueError("nominal_voltage must be given, because voltage_exponent is not zero")
        object.__setattr__(self, "curve", as_tuple(np.asarray(self.curve, float).tolist()))


class Actuated(AbstractVectorField):
    """A multirotor driven by commands: x = [state, rotor speeds] (13 + n), or (13) without lag, u = [c, V].

    u has one command for each rotor, followed by the battery voltage if `nominal_voltage` is given.

    Parameters are deviations from the nominal actuator that start at zero: `curve` in units of its value at full
    command, time constants as logarithms, and the others in their own unit. `delay` shifts the log instead of changing
    the equations.

    Attributes:
        body: the field driven by rotor speeds.
        deviations: the deviation of each learned parameter from its nominal value, by name.
        actuator: the nominal curve, lag, voltage and delay.

    Raises:
        ValueError: if a name is unknown, or a voltage exponent is learned without a nominal voltage.
    """

    accepts_batch: ClassVar[bool] = True

    body: RigidBody
    deviations: dict[str, Float[Array, "..."]]
    actuator: Actuator = eqx.field(static=True)

    def __check_init__(self):
        check_actuator_names(tuple(self.deviations), self.actuator)

    @property
    def rotor_states(self) -> int:
        """The number of rotor speeds after the 13 states of the body: 0 without lag."""
        lags = {"time_constant", "time_constants"} & self.deviations.keys() or self.actuator.time_constants[0]
        return self.body.vehicle.rotors if lags else 0

    @property
    def state_space(self):
        if not self.rotor_states:
            return RIGID_BODY_SPACE
        speeds = Quantity("rotor speeds", self.rotor_states, "rad/s", tuple(f"w{i}" for i in range(self.rotor_states)))
        return replace(RIGID_BODY_SPACE, quantities=(*RIGID_BODY_SPACE.quantities, speeds))

    @property
    def parameter_units(self):
        return self.body.parameter_units | UNITS | {"curve": "rad/s" if self.actuator.gives == "speed" else "N"}

    @property
    def state_size(self) -> int:
        """The size of x: 13, plus the rotor speeds if they lag."""
        return STATE_SIZE + self.rotor_states

    @property
    def input_size(self) -> int:
        """The size of u: a command for each rotor, plus the voltage if it matters."""
        return self.body.vehicle.rotors + self.reads_voltage

    @property
    def reads_voltage(self) -> bool:
        """Whether the last input is the battery voltage."""
        return self.actuator.nominal_voltage > 0

    def theta(self) -> dict[str, Array]:
        """Return the learned parameters of the body and of the actuator, in SI units."""
        return self.body.theta() | {name: self._value(name) for name in self.deviations}

    def _value(self, name: str) -> Array:
        at, known = self.deviations.get(name, 0.0), self.actuator
        if name == "curve":
            return jnp.asarray(known.curve) + abs(sum(known.curve) or 1.0) * jnp.asarray(at)
        if name in ("time_constant", "time_constants"):
            return self.time_constants()[0 if name == "time_constant" else slice(None)]
        return getattr(known, name) + jnp.asarray(at)

    @property
    def delay(self) -> Array:
        """The time between logging a command and its effect [s]."""
        return self._value("delay")

    def time_constants(self) -> Float[Array, "2"]:
        """Return τ_up and τ_down [s]."""
        at = self.deviations.get("time_constant", self.deviations.get("time_constants", 0.0))
        return jnp.maximum(jnp.asarray(self.actuator.time_constants), QUICKEST) * jnp.exp(jnp.asarray(at))

    def steady_speeds(self, u: Float[Array, " m *b"]) -> Float[Array, " n *b"]:
        """Return w∞, the rotor speeds [rad/s] once they have settled under commands and voltage."""
        vehicle = self.body.vehicle
        commands = u[: vehicle.rotors]
        if self.reads_voltage:
            commands = commands * (u[vehicle.rotors] / self.actuator.nominal_voltage) ** self._value("voltage_exponent")
        value = jnp.polyval(self._value("curve")[::-1], commands)
        if self.actuator.gives == "speed":
            return value
        least = SLOWEST_SHARE * vehicle.hover_speed
        return jnp.sqrt(jnp.maximum(value / vehicle.thrust_coefficient, least**2))

    def speeds(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " n *b"]:
        """Return the rotor speeds w [rad/s] of the state or, without lag, the steady ones."""
        return x[STATE_SIZE:] if self.rotor_states else self.steady_speeds(u)

    def __call__(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        moved = self.body(x[:STATE_SIZE], self.speeds(x, u))
        if not self.rotor_states:
            return moved
        missing, (up, down) = self.steady_speeds(u) - x[STATE_SIZE:], self.time_constants()
        return jnp.concatenate([moved, missing / jnp.where(missing > 0, up, down)])

    def apply_residual(self, x, residual):
        changed = as_field(self.body).apply_residual(x[:STATE_SIZE], residual[:STATE_SIZE])
        return jnp.concatenate([changed, residual[STATE_SIZE:]])

    def settled(self, u: Float[Array, "t m"], dt: float) -> Float[Array, " n"]:
        """Return the rotor speeds [rad/s] after the inputs u (t, m), beginning at equilibrium; u is piecewise constant.

        Args:
            dt: duration of each input [s].
        """
        targets, (up, down) = self.steady_speeds(u.T).T, self.time_constants()
        kept = jnp.exp(-dt / up), jnp.exp(-dt / down)

        def interval(w, target):
            return target + (w - target) * jnp.where(target > w, *kept), None

        return jax.lax.scan(interval, targets[0], targets)[0]


def actuated(body: RigidBody, actuator: Actuator, learn: tuple[str, ...] = ()) -> Actuated:
    """Return the body with its actuators.

    Args:
        body: the field driven by rotor speeds.
        actuator: the nominal map from command to rotor speed.
        learn: names of the actuator parameters to learn, from `actuators.NAMES`; by default none. ValueError if they
            are unknown, or not identifiable together.
    """
    check_actuator_names(learn, actuator, tuple(body.deviations))
    shapes = {"curve": (len(actuator.curve),), "time_constants": (2,)}
    return Actuated(body, {name: jnp.zeros(shapes.get(name, ())) for name in learn}, actuator)


class SampledRotors(AbstractHidden):
    """Rotor speeds between two samples, for `with_hidden`: each lags behind a command that is held in between.

        w(t) = w₀ + (w₁ − w₀) (1 − e^{−t/τ}) / (1 − e^{−Δ/τ}),   0 ≤ t ≤ Δ

    The inputs (2n,) are the speeds w₀ of the n rotors at the start of an interval and w₁ at its end [rad/s], see
    `trajectories.pair_inputs`. The field receives the root mean square of w (n,), because thrust is proportional to w².
    It has no states.

    Attributes:
        log_time_constant: ln τ, with τ in seconds.
        dt: the duration Δ of an interval [s].
    """

    log_time_constant: Float[Array, ""]
    dt: float = eqx.field(static=True)

    @property
    def size(self) -> int:
        return 0

    def derivative(self, z, x, u):
        return jnp.zeros(0)

    def inputs(self, z, u):
        start, end = jnp.split(jnp.asarray(u), 2)
        shares, weights = (jnp.asarray(each, start.dtype) for each in ((NODES + 1) / 2, WEIGHTS / 2))
        ratio = self.dt / jnp.exp(self.log_time_constant)
        passed = jnp.expm1(-ratio * shares) / jnp.expm1(-ratio)
        square = weights @ (start + passed[:, None] * (end - start)) ** 2
        return jnp.sqrt(jnp.maximum(square, jnp.finfo(square.dtype).tiny))  # a root has no slope at zero


def check_actuator_names(learn: tuple[str, ...], actuator: Actuator, of_body: tuple[str, ...] = ()) -> None:
    """Raise ValueError for names not in `NAMES`, or not identifiable together or with parameters of the body."""
    for name in learn:
        if name not in NAMES:
            raise ValueError(f"learn must be names of {', '.join(NAMES)}, got {checks.short_repr(name)}")
        for other in EXCLUSIVE.get(name, ()):
            if other in (*learn, *of_body):
                raise ValueError(f"learn must not name both {name} and {other}: both contain a common factor")
    if "voltage_exponent" in learn and not actuator.nominal_voltage:
        raise ValueError("nominal_voltage must be given in [actuator], because voltage_exponent is learned")


def rotor_speeds(
    field: Actuated, t: Float[np.ndarray, " n"], commands: Float[np.ndarray, "n m"], edges: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k-1 r"]:
    """Convert commands to the mean rotor speeds [rad/s] of each interval, one row for each interval.

    Args:
        field: the body with its actuators.
        t: times (n,) of the inputs [s]; each input is held until the next.
        commands: inputs u (n, m) of the field at these times, with the voltage [V] last if the field reads it.
        edges: edges (k,) of the intervals [s], which should ascend.
    """
    u = np.asarray(held_means(jnp.asarray(t), jnp.asarray(commands), jnp.asarray(edges), field.delay))
    targets = np.asarray(field.steady_speeds(jnp.asarray(u.T)).T)
    if not field.rotor_states:
        return targets
    w, found = targets[0], np.empty_like(targets)
    for i, (target, span) in enumerate(zip(targets, np.diff(edges), strict=True)):
        tau = np.where(target > w, *np.asarray(field.time_constants()))
        end = target + (w - target) * np.exp(-span / tau)
        found[i], w = target + (w - end) * tau / span, end
    return found


def held_means(t: Numbers, values: Numbers, edges: Numbers, delay: Array | float = 0.0) -> Float[Array, "k-1 m"]:
    """Average values (n, m), held from times t (n) + `delay` [s] (the first also before), between `edges` (k) [s]."""
    area = jnp.concatenate([jnp.zeros((1, values.shape[1])), jnp.cumsum(values[:-1] * jnp.diff(t)[:, None], axis=0)])
    at = edges - delay
    i = jnp.clip(jnp.searchsorted(t, at, side="right") - 1, 0, len(t) - 1)
    total = area[i] + values[i] * (at - t[i])[:, None]
    return jnp.diff(total, axis=0) / jnp.diff(edges)[:, None]
