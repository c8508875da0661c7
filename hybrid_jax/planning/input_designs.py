"""Trajectories from Fourier series, and their use of each limit.

A multirotor's series are its flat outputs, position and yaw (Mellinger and Kumar 2011). For any other system they are
its inputs, squashed into their limits.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.control.cost import Scalar
from hybrid_jax.control.references import Path, attitude_along
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.integrate import rollout
from hybrid_jax.rotation import body_z, conjugate, heading, multiply
from hybrid_jax.vehicle import POSITION, QUATERNION, VELOCITY, Vehicle

Coefficients = Float[Array, "outputs harmonics 2"]  # of sine and cosine, in units of `unit`
Trajectory = tuple[Float[Array, "n+1 d"], Float[Array, "n m"]]

RAMP = 1.0  # s, from and to hover
# From 0 to 1 with four continuous derivatives, since torques depend on the fourth derivative of position.
SMOOTH = np.polynomial.Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])


@dataclass(frozen=True)
class FlightBounds:
    """The box and the limits of a multirotor's flight.

    Attributes:
        low: the corner of the box with the smallest x, y and z [m]; z points up.
        high: the opposite corner [m].
        speed: the highest speed [m/s].
        tilt: the largest angle between thrust and the vertical [rad], below π/2.
        yaw: the largest heading to either side of 0 [rad].
        rotor_speed: the lowest and highest rotor speed, as fractions of the vehicle's highest speed.

    Raises:
        ValueError: if the box is empty, a limit is not positive, or the tilt or a fraction is out of range.
    """

    low: tuple[float, float, float] = (-3.0, -3.0, 0.5)
    high: tuple[float, float, float] = (3.0, 3.0, 3.0)
    speed: float = 4.0
    tilt: float = 0.6
    yaw: float = 1.5
    rotor_speed: tuple[float, float] = (0.2, 0.9)

    def __post_init__(self):
        _check_box("low", self.low, "high", self.high, 3)
        checks.positive("speed", self.speed)
        checks.positive("yaw", self.yaw)
        if not 0 < (checks.real(self.tilt) or 0) < math.pi / 2:
            raise ValueError(f"tilt must be between 0 and π/2 rad, got {checks.short_repr(self.tilt)}")
        _check_box("rotor_speed[0]", self.rotor_speed[:1], "rotor_speed[1]", self.rotor_speed[1:], 1)
        if not 0 <= self.rotor_speed[0] < self.rotor_speed[1] <= 1:
            raise ValueError(f"rotor_speed must be two shares between 0 and 1, got {self.rotor_speed}")


@dataclass(frozen=True)
class InputBounds:
    """The limits of any system's inputs, its initial state, and optionally a box for its states.

    Attributes:
        low: the lower limit of each of the m inputs, in its own unit.
        high: the upper limit of each input.
        start: the initial state, d numbers.
        state_low: the lower limit of each of the d states; None for no box. You must set it together with `state_high`.
        state_high: the upper limit of each state; None for no box.

    Raises:
        ValueError: if the box is empty, or tuples have different lengths.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    start: tuple[float, ...]
    state_low: tuple[float, ...] | None = None
    state_high: tuple[float, ...] | None = None

    def __post_init__(self):
        _check_box("low", self.low, "high", self.high)
        checks.finite("start", np.asarray(checks.real_array("start", self.start), float))
        if (self.state_low is None) != (self.state_high is None):
            raise ValueError("state_low and state_high must be given together")
        if self.state_low is not None:
            _check_box("state_low", self.state_low, "state_high", self.state_high, len(self.start))


def _check_box(name: str, low, other: str, high, size: int | None = None) -> None:
    arrays = [np.asarray(checks.finite(one, checks.real_array(one, end))) for one, end in ((name, low), (other, high))]
    if arrays[0].ndim != 1 or {len(array) for array in arrays if array.ndim} != {size or len(arrays[0])}:
        raise ValueError(f"{name} and {other} must be {size or 'equally many'} numbers, got {low} and {high}")
    if not (arrays[0] < arrays[1]).all():
        raise ValueError(f"{name} must be below {other}, else the box is empty; got {low} and {high}")


class FlatOutputs(eqx.Module):
    """Flights that start and end in hover at the centre of the box."""

    vehicle: Vehicle = eqx.field(static=True)
    bounds: FlightBounds = eqx.field(static=True)
    seconds: float = eqx.field(static=True)
    harmonics: int = eqx.field(static=True)
    dt: float = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        return "x", "y", "z", "speed", "tilt", "yaw", *(f"rotor_speed[{i}]" for i in range(self.vehicle.rotors))

    @property
    def shape(self) -> tuple[int, int, int]:
        return 4, self.harmonics, 2

    def unit(self) -> Float[np.ndarray, "4 harmonics 1"]:
        """Return the amplitudes that use up the box, the tilt, or the thrust within the rotors' range."""
        vehicle, bounds = self.vehicle, self.bounds
        least, most = (share * vehicle.max_rotor_speed for share in bounds.rotor_speed)
        thrust = vehicle.thrust_coefficient * (most**2 - least**2) / 2  # of each rotor, either way [N]
        arms = np.abs(np.array(vehicle.rotor_positions)).sum(axis=0)
        roll, pitch = thrust * arms[::-1] / np.array(vehicle.inertia[:2])
        turn = vehicle.torque_coefficient / vehicle.thrust_coefficient * thrust * vehicle.rotors / vehicle.inertia[2]
        rates = 2 * np.pi * np.arange(1, self.harmonics + 1) / self.seconds
        tilts = [np.minimum(np.tan(bounds.tilt), each / rates**2) for each in (pitch, roll)]  # along x, along y
        lift = np.full(self.harmonics, thrust * vehicle.rotors / vehicle.mass)
        accelerations = np.stack([vehicle.gravity * tilts[0], vehicle.gravity * tilts[1], lift, 0 * lift + turn])
        half = (np.array(bounds.high) - np.array(bounds.low)) / 2
        return np.minimum(np.append(half, bounds.yaw)[:, None], accelerations / rates**2)[..., None]

    def path(self, coefficients: Coefficients) -> Path:
        centre = np.append((np.array(self.bounds.high) + np.array(self.bounds.low)) / 2, 0.0)
        amplitudes = coefficients * self.unit()

        def path(t: Scalar) -> tuple[Float[Array, "3"], Scalar]:
            ramp = jnp.polyval(jnp.asarray(SMOOTH.coef[::-1]), jnp.clip(jnp.minimum(t, self.seconds - t) / RAMP, 0, 1))
            flat = jnp.asarray(centre, amplitudes.dtype) + ramp * _series(amplitudes, t, self.seconds)
            return flat[:3], flat[3]

        return path

    def trajectory(self, coefficients: Coefficients, model: AbstractVectorField) -> Trajectory:
        """Return reference states, and the rotor speeds of a rigid body that follows them without drag."""
        times = self.dt * np.arange(round(self.seconds / self.dt) + 1)
        place, q, velocity, rates = self._moving(coefficients, times)[:4]
        states = jnp.concatenate([place[:, :3], q, velocity[:, :3], rates], axis=1)
        _, _, _, rates, lift, turning = self._moving(coefficients, times[:-1] + self.dt / 2)
        vehicle, inertia = self.vehicle, np.array(self.vehicle.inertia, np.float32)
        torque = inertia * turning + jnp.cross(rates, inertia * rates)
        thrust = vehicle.mass * jnp.linalg.norm(lift, axis=1, keepdims=True)
        mixing = jnp.asarray(np.linalg.pinv(vehicle.mixer).T, lift.dtype)
        squares = jnp.concatenate([thrust, torque], axis=1) @ mixing
        # Negative beyond the limits, so that a search can return, and without an infinite slope.
        return states, jnp.where(squares < 0, -1.0, 1.0) * jnp.sqrt(jnp.maximum(jnp.abs(squares), 1.0))

    def _moving(self, coefficients: Coefficients, times: Float[np.ndarray, " n"]) -> list[Array]:
        """Return flat outputs, attitude, its slope, body rates, specific force, and the slope of the body rates."""
        amplitudes = (coefficients * self.unit()).reshape(4, -1)
        basis = _derivatives(times, self.seconds, self.harmonics)
        flat, slope, *others = (jnp.asarray(each, amplitudes.dtype) @ amplitudes.T for each in basis)
        flat = flat + np.append((np.array(self.bounds.high) + np.array(self.bounds.low)) / 2, 0.0).astype(flat.dtype)
        lift = others[0][:, :3] + self.vehicle.gravity * np.eye(3, dtype=flat.dtype)[2]

        def turned(lift, jerk, snap, yaw):
            """Return attitude, body rates and their slope from thrust and yaw as polynomials of time."""

            def attitude(s):
                return attitude_along(lift + jerk * s + snap * s**2 / 2, yaw[0] + yaw[1] * s + yaw[2] * s**2 / 2)

            def rates(s):
                q, turning = jax.jvp(attitude, (s,), (jnp.ones_like(s),))
                return 2 * multiply(conjugate(q), turning)[1:]

            zero = jnp.zeros_like(lift[0])
            return attitude(zero), *jax.jvp(rates, (zero,), (jnp.ones_like(zero),))

        yaw = jnp.stack([flat[:, 3], slope[:, 3], others[0][:, 3]], axis=1)
        q, rates, turning = jax.vmap(turned)(lift, others[1][:, :3], others[2][:, :3], yaw)
        return [flat, q, slope, rates, lift, turning]

    def uses(self, x: Float[Array, "n+1 13"], u: Float[Array, "n rotors"]) -> Float[Array, "n limits"]:
        """Return the used fraction of each limit of `names` over time."""
        bounds, x = self.bounds, x[1:]
        low, high = np.array(bounds.low), np.array(bounds.high)
        place = jnp.abs(x[:, POSITION] - (low + high) / 2) / ((high - low) / 2)
        speed = jnp.sqrt(jnp.sum(jnp.square(x[:, VELOCITY]), axis=1) + 1e-12) / bounds.speed
        upright = jax.vmap(body_z)(x[:, QUATERNION])[:, 2]
        tilt = (1 - upright) / (1 - math.cos(bounds.tilt))
        yaw = jnp.abs(heading(x[:, QUATERNION])) / bounds.yaw
        least, most = (share * self.vehicle.max_rotor_speed for share in bounds.rotor_speed)
        rotors = jnp.abs(2 * (u * jnp.abs(u) - least**2) / (most**2 - least**2) - 1)
        return jnp.column_stack([place, speed, tilt, yaw, rotors])


class InputSeries(eqx.Module):
    """Inputs as tanh of a Fourier series between their limits; large coefficients switch between the two."""

    bounds: InputBounds = eqx.field(static=True)
    seconds: float = eqx.field(static=True)
    harmonics: int = eqx.field(static=True)
    dt: float = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        limited = range(len(self.bounds.start)) if self.bounds.state_low is not None else ()
        return tuple(f"x{i}" for i in limited)

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.bounds.low), self.harmonics + 1, 2  # the first for a constant

    def path(self, coefficients: Coefficients) -> Callable[[Scalar], Float[Array, " m"]]:
        low, high = np.array(self.bounds.low), np.array(self.bounds.high)

        def inputs(t: Scalar) -> Float[Array, " m"]:
            series = _series(coefficients[:, 1:], t, self.seconds) + coefficients[:, 0, 1]
            return jnp.asarray((low + high) / 2 + (high - low) / 2 * jnp.tanh(series))

        return inputs

    def trajectory(self, coefficients: Coefficients, model: AbstractVectorField) -> Trajectory:
        middles = self.dt * (jnp.arange(round(self.seconds / self.dt)) + 0.5)
        u, start = jax.vmap(self.path(coefficients))(middles), jnp.asarray(self.bounds.start, float)
        return jnp.concatenate([start[None], rollout(model, start, u, self.dt)]), u

    def uses(self, x: Float[Array, "n+1 d"], u: Float[Array, "n m"]) -> Float[Array, "n limits"]:
        if self.bounds.state_low is None or self.bounds.state_high is None:
            return jnp.zeros((len(u), 0), x.dtype)
        low, high = np.array(self.bounds.state_low), np.array(self.bounds.state_high)
        return jnp.abs(x[1:] - (low + high) / 2) / ((high - low) / 2)


Design = FlatOutputs | InputSeries


def _series(amplitudes: Coefficients, t: Scalar, seconds: float) -> Float[Array, " outputs"]:
    phases = 2 * jnp.pi / seconds * t * np.arange(1, amplitudes.shape[1] + 1)
    return amplitudes[..., 0] @ jnp.sin(phases) + amplitudes[..., 1] @ jnp.cos(phases)


def _derivatives(times: Float[np.ndarray, " n"], seconds: float, harmonics: int) -> list[Float[np.ndarray, "n k"]]:
    """Return sines and cosines of the ramped series, k = 2 harmonics, and their derivatives up to the fourth."""
    rates = 2 * np.pi / seconds * np.arange(1, harmonics + 1)
    up, down = times / RAMP, (seconds - times) / RAMP
    ramps = [
        np.where(up < 1, SMOOTH.deriv(i)(np.clip(up, 0, 1)), i == 0) * np.where(down < 1, 0.0, 1.0) / RAMP**i
        + np.where(down < 1, SMOOTH.deriv(i)(np.clip(down, 0, 1)), 0.0) * (-1 / RAMP) ** i
        for i in range(5)
    ]

    def wave(i: int) -> np.ndarray:
        phases = np.outer(times, rates) + i * np.pi / 2
        return np.stack([rates**i * np.sin(phases), rates**i * np.cos(phases)], axis=-1).reshape(len(times), -1)

    def term(order: int, i: int) -> np.ndarray:
        return math.comb(order, i) * ramps[i][:, None] * wave(order - i)

    return [np.sum([term(order, i) for i in range(order + 1)], axis=0) for order in range(5)]
