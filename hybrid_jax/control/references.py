"""Reference paths and their conversion to reference states.

A path maps time [s] to position [m, world] and yaw [rad]; differential flatness gives the rest, with thrust along a + g
(Mellinger and Kumar, "Minimum snap trajectory generation and control for quadrotors", 2011). All functions raise
ValueError for numbers that are not finite, or not positive where they should be.
"""

import math
from collections.abc import Callable
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.control.controller import Controller
from hybrid_jax.control.cost import Scalar
from hybrid_jax.rotation import Quaternion, conjugate, from_axis_angle, multiply
from hybrid_jax.vehicle import BODY_RATES, STATE_SIZE, State

Path = Callable[[Scalar], tuple[Float[Array, "3"], Scalar]]

X, Y, Z = np.eye(3).tolist()


def sample(path: Path, controller: Controller, duration: float) -> Float[Array, "n 13"]:
    """Sample one reference state per period, for a flight of `duration` [s] and the horizon of its last call.

    Args:
        path: function of time [s] to position [m] and yaw [rad], for example `hover()`.
        controller: defines the period, the horizon and gravity.
        duration: length of the flight [s].
    """
    if not callable(path):
        raise ValueError(f"path must be a function of time, for example hover(), got {checks.short_repr(path)}")
    checks.positive("duration", duration, "a positive number of seconds")
    count = round(duration / controller.period) + controller.steps * controller.stride + 1
    times = controller.period * jnp.arange(count)
    return jax.jit(jax.vmap(lambda t: reference_state(path, t, controller.vehicle.gravity)))(times)


def reference_state(path: Path, t: Scalar, gravity: float) -> State:
    """Return the state of a multirotor without drag that follows the path, at time t."""

    def moving(t):
        return jax.jvp(lambda t: path(t)[0], (t,), (jnp.ones_like(t),))

    def attitude(t):
        acceleration = jax.jvp(lambda t: moving(t)[1], (t,), (jnp.ones_like(t),))[1]
        return attitude_along(acceleration + gravity * jnp.array(Z), path(t)[1])

    (position, velocity), (q, turning) = moving(t), jax.jvp(attitude, (t,), (jnp.ones_like(t),))
    rates = 2 * multiply(conjugate(q), turning)[1:]  # from q̇ = ½ q ⊗ [0, ω]
    return jnp.concatenate([position, q, velocity, rates])


def attitude_along(thrust: Float[Array, "3"], yaw: Scalar) -> Quaternion:
    """Return the attitude with z along `thrust` and this yaw: rotations about z, then y, then x."""
    ahead = jnp.cos(yaw) * thrust[0] + jnp.sin(yaw) * thrust[1]
    left = jnp.cos(yaw) * thrust[1] - jnp.sin(yaw) * thrust[0]
    pitch = jnp.arctan2(ahead, thrust[2])
    # Not hypot, which has no second derivative at hover.
    roll = jnp.arctan2(-left, jnp.sqrt(ahead**2 + thrust[2] ** 2))
    return reduce(multiply, [from_axis_angle(jnp.array(axis), by) for axis, by in ((Z, yaw), (Y, pitch), (X, roll))])


def hover(position: tuple[float, float, float] = (0.0, 0.0, 1.0), yaw: float = 0.0) -> Path:
    """Stay at a position [m] with a yaw [rad].

    Args:
        position: (x, y, z) in the world [m].
        yaw: angle about the world's z axis [rad].
    """
    _check_vector("position", position)
    checks.number("yaw", yaw)
    return lambda t: (jnp.array(position) + 0 * t, jnp.asarray(yaw) + 0 * t)


def figure_eight(top_speed: float, half_width: float = 4.0, altitude: float = 1.5) -> Path:
    """Fly Gerono's lemniscate, x = a sin φ, y = a sin φ cos φ, with constant φ̇; the speed at its centre is √2 a φ̇.

    Args:
        top_speed: speed at the centre [m/s].
        half_width: a, the largest distance from the centre along x [m].
        altitude: height above the origin [m].
    """
    checks.positive("top_speed", top_speed)
    checks.positive("half_width", half_width)
    checks.number("altitude", altitude)
    rate = top_speed / (math.sqrt(2) * half_width)  # rad/s

    def path(t):
        phase = rate * t
        place = jnp.stack([jnp.sin(phase), jnp.sin(2 * phase) / 2, 0 * t])
        return half_width * place + altitude * jnp.array(Z), 0 * t

    return path


def step(to: tuple[float, float, float], at: float = 1.0, yaw: float = 0.0, altitude: float = 1.5) -> Path:
    """Hover over the origin; at time `at` [s] the position jumps by `to` [m] and the yaw to `yaw` [rad].

    Args:
        to: jump of the position (x, y, z) [m].
        at: time of the jump [s].
        yaw: yaw after the jump [rad]; 0 before it.
        altitude: height before the jump [m].
    """
    _check_vector("to", to)
    for name, value in (("at", at), ("yaw", yaw), ("altitude", altitude)):
        checks.number(name, value)

    def path(t):
        after = jnp.where(t >= at, 1.0, 0.0)
        return altitude * jnp.array(Z) + after * jnp.array(to), yaw * after

    return path


def low_flyby(speed: float = 2.0, low: float = 0.15, high: float = 1.0, every: float = 5.0) -> Path:
    """Fly along x at `speed` [m/s], down to the altitude `low` [m] and up to `high`, every `every` seconds.

    The altitude follows cos⁴, which is flat at the bottom: 40 % of the time is spent in the lowest tenth.

    Args:
        speed: speed along x [m/s].
        low: lowest altitude [m], above 0.
        high: highest altitude [m].
        every: time from one highest point to the next [s].
    """
    checks.number("speed", speed)
    checks.number("high", high)
    checks.positive("low", low)
    checks.positive("every", every)
    if not low < high:
        raise ValueError(f"high must be above low {low}, got {high}")

    def path(t):
        altitude = low + (high - low) * jnp.cos(jnp.pi * t / every) ** 4
        return jnp.stack([speed * t, 0 * t, altitude]), 0 * t

    return path


def add_body_rates(state: State, rates: tuple[float, float, float] = (6.0, 0.0, 0.0)) -> State:
    """Add body rates [rad/s] to a state, for example as a difficult initial condition.

    Args:
        state: state of a multirotor (13,).
        rates: increments of the body rates (x, y, z) [rad/s].
    """
    state = checks.floating("state", state)
    if state.shape != (STATE_SIZE,):
        raise ValueError(f"state (13,) expected, got {state.shape}")
    _check_vector("rates", rates)
    return state.at[BODY_RATES].add(jnp.array(rates))


def _check_vector(name: str, value: tuple[float, float, float]) -> None:
    array = checks.finite(name, checks.real_array(name, value))  # no JAX array: modules define paths at import
    if array.shape != (3,):
        raise ValueError(f"{name} must be three numbers (x, y, z), got {checks.short_repr(value)}")
