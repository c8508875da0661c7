"""A pilot for random flight at 100 Hz between waypoints, sometimes close to the ground, with dither on all axes."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax.rotation import Vector, body_z, conjugate, from_axis_angle, multiply, normalise
from hybrid_jax.sim.forces import Parameters, Scalar
from hybrid_jax.vehicle import BODY_RATES, IRIS, POSITION, QUATERNION, VELOCITY, Input, State, Vehicle

PERIOD = 0.01  # s between decisions
FASTEST = 1 / 3  # scale of time below which the rate loop would be too fast for PERIOD

# Waypoints: a box around home, each held for a while and approached at its own speed.
ARENA = 6.0  # m, |x| and |y|
HOLD = (0.6, 2.2)  # s
CRUISE = (1.0, 4.5)  # m/s
CLIMB = (0.8, 2.0)  # m/s
LOW, HIGH = (0.14, 0.32), (0.32, 3.0)  # m
LOW_SHARE = 0.3  # of the waypoints
HEADING = 2.4  # rad: short of π, so that the quaternion stays on the sheet qw > 0
TURN = (0.5, 2.0)  # rad/s
ACCELERATION = (5.0, 5.0, 3.0, 4.0)  # m/s² and rad/s²: how hard the reference (x, y, z, heading) may turn

# Dither: a sum of sinusoids in angular acceleration about x, y, z and vertical acceleration.
TONES = 5
BAND = (1.0, 5.0)  # Hz
DITHER = (5.0, 5.0, 2.5, 1.0)  # rms, rad/s² and m/s²

# Gains of the cascade and limits of its commands.
POSITION_GAIN, VELOCITY_GAIN, INTEGRAL_GAIN = 4.0, 3.2, 1.2  # 1/s², 1/s, 1/s³
INTEGRAL_LIMIT = 4.0  # m/s²
ATTITUDE_GAIN = (9.0, 9.0, 4.0)  # 1/s
RATE_GAIN = (20.0, 20.0, 10.0)  # 1/s
MAX_TILT = 0.62  # rad
GENTLE = 2.0  # m/s²
CLEARANCE = 0.07  # m: every descent ends above this
ASTRAY, SAFE_ALTITUDE = 13.0, 1.5  # m: beyond the first, from home, climb to the second, where tilting is safe
DIP, ARM = 0.12, 0.26  # near the ground, a rotor at the distance ARM [m] dips by at most DIP of the altitude


class Scale(NamedTuple):
    """Ratios of a vehicle's quantities to the Iris's, by Froude scaling.

    Flights are geometrically similar at the same tilt and thrust over weight, with times proportional to the root of
    lengths. Small vehicles fly more slowly, so that 100 Hz suffice to control them.
    """

    length: float
    time: float
    speed: float
    acceleration: float


def scale_of(vehicle: Vehicle) -> Scale:
    """Return the scale of a vehicle, from the distance of its outermost rotor."""
    arm, arm_of_iris = (max(math.hypot(x, y) for x, y in each.rotor_positions) for each in (vehicle, IRIS))
    length = arm / arm_of_iris
    time = max(math.sqrt(length), FASTEST)
    return Scale(length, time, length / time, length / time**2)


class Course(NamedTuple):
    """The reference and the dither at each decision of one flight."""

    position: Float[Array, "*t 3"]  # m, world
    velocity: Float[Array, "*t 3"]  # m/s, world
    heading: Float[Array, "*t"]  # rad
    dither: Float[Array, "*t 4"]  # angular acceleration [rad/s², body], acceleration along the thrust [m/s²]


def draw_course(steps: int, scale: Scale, key: PRNGKeyArray) -> Course:
    key_targets, key_dither = jax.random.split(key)
    target, limit = _draw_waypoints(steps, scale, key_targets)
    hardest = jnp.array(ACCELERATION) * np.array([*[scale.acceleration] * 3, 1 / scale.time**2])

    def follow(carry, waypoint):
        place, rate = carry
        goal, fastest = waypoint
        wanted = _shorten(1.6 / scale.time * (goal - place), fastest)
        rate = rate + PERIOD * jnp.clip(5.0 / scale.time * (wanted - rate), -hardest, hardest)
        place = place + PERIOD * rate
        return (place, rate), (place, rate)

    _, (place, rate) = jax.lax.scan(follow, (target[0], jnp.zeros(4)), (target, limit))
    return Course(place[:, :3], rate[:, :3], place[:, 3], _draw_dither(steps, scale, key_dither))


def _shorten(velocity: Float[Array, "4"], fastest: Vector) -> Float[Array, "4"]:
    """Limit the horizontal speed, keeping its direction, the climb and the turn."""
    speed = jnp.linalg.norm(velocity[:2]) + 1e-9
    plane = velocity[:2] * jnp.minimum(1.0, fastest[0] / speed)
    return jnp.concatenate([plane, jnp.clip(velocity[2:], -fastest[1:], fastest[1:])])


def _draw_waypoints(steps: int, scale: Scale, key: PRNGKeyArray) -> tuple[Float[Array, "t 4"], Float[Array, "t 3"]]:
    """Return the waypoint (x, y, z, heading) and limits (cruise, climb, turn) at each decision."""
    count = int(steps * PERIOD / (HOLD[0] * scale.time)) + 2
    # One draw for all numbers, because each call of a random function takes a third of a second to compile.
    draw = jax.random.uniform(key, (9, count))
    low, high = (_between(bounds, draw[3], scale.length) for bounds in (LOW, HIGH))
    altitude = jnp.where(draw[2] < LOW_SHARE, low, high)
    arena = ARENA * scale.length
    place = [arena * (2 * draw[0] - 1), arena * (2 * draw[1] - 1), altitude, HEADING * (2 * draw[4] - 1)]
    fastest = (CRUISE, draw[5], scale.speed), (CLIMB, draw[6], scale.speed), (TURN, draw[7], 1 / scale.time)
    limit = [_between(*each) for each in fastest]
    departure = jnp.cumsum(_between(HOLD, draw[8], scale.time))
    current = jnp.searchsorted(departure, PERIOD * jnp.arange(steps))
    return jnp.stack(place, axis=1)[current], jnp.stack(limit, axis=1)[current]


def _between(bounds: tuple[float, float], share: Float[Array, "*n"], scale: float) -> Float[Array, "*n"]:
    return bounds[0] * scale + (bounds[1] - bounds[0]) * scale * share


def _draw_dither(steps: int, scale: Scale, key: PRNGKeyArray) -> Float[Array, "t 4"]:
    share_of_band, share_of_turn = jax.random.uniform(key, (2, TONES, 4))
    frequency, phase = _between(BAND, share_of_band, 1 / scale.time), 2 * jnp.pi * share_of_turn
    time = PERIOD * jnp.arange(steps)[:, None, None]
    rms = np.array(DITHER) * np.array([*[1 / scale.time**2] * 3, scale.acceleration])
    return jnp.sqrt(2 / TONES) * jnp.array(rms) * jnp.sin(2 * jnp.pi * frequency * time + phase).sum(axis=1)


def act(
    integral: Vector, x: State, course: Course, nominal: Parameters, vehicle: Vehicle, scale: Scale
) -> tuple[Vector, Input]:
    """Return the new integral [m/s², world frame] and feasible rotor speeds [rad/s] for an entry of the course."""
    # Raise the reference to a safe altitude if wind has blown the vehicle far away.
    far, place = jnp.linalg.norm(x[POSITION][:2]) > ASTRAY * scale.length, course.position
    place = place.at[2].set(jnp.where(far, jnp.maximum(place[2], SAFE_ALTITUDE * scale.length), place[2]))
    error = place - x[POSITION]
    limit, time = INTEGRAL_LIMIT * scale.acceleration, scale.time
    integral = jnp.clip(integral + PERIOD * (INTEGRAL_GAIN / time**3) * error, -limit, limit)
    wanted = POSITION_GAIN / time**2 * error + VELOCITY_GAIN / time * (course.velocity - x[VELOCITY]) + integral
    climbing = _flare(wanted[2], x[POSITION][2], x[VELOCITY][2], scale)
    lift = _limit_tilt(wanted.at[2].set(climbing + nominal.gravity), x[POSITION][2], nominal.gravity, scale)
    spin_up = _angular_acceleration(x, lift, course.heading, scale) + course.dither[:3]
    rates = x[BODY_RATES]
    torque = nominal.inertia * spin_up + jnp.cross(rates, nominal.inertia * rates)
    along_thrust = jnp.dot(lift, body_z(x[QUATERNION])) + course.dither[3]
    thrust = nominal.mass * jnp.clip(along_thrust, 0.3 * nominal.gravity, 2.0 * nominal.gravity)
    return integral, _allocate(thrust, torque, vehicle)


def _flare(wanted: Scalar, altitude: Scalar, climb: Scalar, scale: Scale):
    """Raise the vertical acceleration [m/s²] to what stops the descent above ground, once that exceeds GENTLE."""
    sink = jnp.minimum(climb, 0.0)
    needed = sink**2 / (2 * jnp.maximum(altitude - CLEARANCE * scale.length, 0.03 * scale.length))
    return jnp.where(needed > GENTLE * scale.acceleration, jnp.maximum(wanted, needed), wanted)


def _limit_tilt(lift: Vector, altitude: Scalar, gravity: Scalar, scale: Scale) -> Vector:
    """Limit the acceleration [m/s², world frame] to upward thrust, and to tilts with all rotors off the ground."""
    up = jnp.clip(lift[2], 0.5 * gravity, 1.7 * gravity)
    lowest = jnp.arcsin(jnp.clip(DIP * altitude / (ARM * scale.length), 0.05, 1.0))
    sideways = jnp.linalg.norm(lift[:2]) + 1e-9
    factor = jnp.minimum(1.0, up * jnp.tan(jnp.minimum(lowest, MAX_TILT)) / sideways)
    return jnp.concatenate([lift[:2] * factor, up[None]])


def _angular_acceleration(x: State, lift: Vector, heading: Scalar, scale: Scale) -> Vector:
    """Return the angular acceleration [rad/s², body] that turns thrust towards lift and the nose to heading [rad]."""
    yaw = from_axis_angle(jnp.array([0.0, 0.0, 1.0]), heading)
    dx, dy, dz = lift / jnp.linalg.norm(lift)
    tilt = normalise(jnp.stack([1 + dz, -dy, dx, jnp.zeros_like(dz)]))  # the shortest turn of world z to lift
    wanted = multiply(tilt, yaw)
    error = multiply(conjugate(x[QUATERNION]), wanted)
    rates = jnp.array(np.array(ATTITUDE_GAIN) / scale.time) * 2 * jnp.sign(error[0]) * error[1:]
    return jnp.array(np.array(RATE_GAIN) / scale.time) * (rates - x[BODY_RATES])


def _allocate(thrust: Scalar, torque: Vector, vehicle: Vehicle) -> Input:
    """Return rotor speeds [rad/s] for a thrust [N] and a torque [N m, body frame], clipped to their limits."""
    wrench = jnp.concatenate([thrust[None], torque])
    mixer, rotors = jnp.asarray(vehicle.mixer, wrench.dtype), vehicle.rotors
    if rotors <= 4:  # three rotors cannot control yaw
        squared = jnp.linalg.solve(mixer[:rotors], wrench[:rotors])
    else:  # the smallest squares that give the wrench; rows are scaled, because they differ by far
        size = jnp.linalg.norm(mixer, axis=1)
        mixer = mixer / size[:, None]
        squared = mixer.T @ jnp.linalg.solve(mixer @ mixer.T, wrench / size)
    return jnp.sqrt(jnp.clip(squared, 0.0, vehicle.max_rotor_speed**2))


def starting_state(course: Course, scale: Scale, key: PRNGKeyArray) -> State:
    """Draw a random state near the start of a course, slightly tilted, drifting and turning."""
    draw = jax.random.normal(key, (3, 3))
    level = from_axis_angle(jnp.array([0.0, 0.0, 1.0]), course.heading[0])
    tilted = multiply(level, from_axis_angle(draw[0] / jnp.linalg.norm(draw[0]), jnp.asarray(0.05)))
    velocity = 0.3 * scale.speed * draw[1].at[2].set(0.0)
    return jnp.concatenate([course.position[0], tilted, velocity, 0.3 / scale.time * draw[2]])
