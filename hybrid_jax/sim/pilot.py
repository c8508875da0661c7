"""A pilot for random flight: it wanders between waypoints, sometimes close to the ground, and shakes the vehicle.

A `Plan` holds all that is random and is drawn before take-off; `act` is the closed loop, a cascade of position,
velocity, attitude and rate control at 100 Hz. The pilot knows the nominal vehicle only: a shifted one or wind it merely
tolerates.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax.rotation import body_z, conjugate, from_axis_angle, multiply, normalise
from hybrid_jax.sim.forces import Parameters
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY, Input, State

PERIOD = 0.01  # s, one decision

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

# Gains of the cascade and limits of what is asked of the vehicle.
POSITION_GAIN, VELOCITY_GAIN, INTEGRAL_GAIN = 4.0, 3.2, 1.2  # 1/s², 1/s, 1/s³
INTEGRAL_LIMIT = 4.0  # m/s²
ATTITUDE_GAIN = (9.0, 9.0, 4.0)  # 1/s
RATE_GAIN = (20.0, 20.0, 10.0)  # 1/s
MAX_TILT = 0.62  # rad
GENTLE = 2.0  # m/s²
CLEARANCE = 0.07  # m: no descent goes on below this
ASTRAY, SAFE_ALTITUDE = 13.0, 1.5  # m from home, m: beyond the one go up to the other, where tilting is safe
DIP, ARM = 0.12, 0.26  # near the ground a rotor this far out [m] dips by no more than this share of the altitude


class Plan(NamedTuple):
    """What the pilot means to do at each decision of one flight.

    Attributes:
        position: reference [m, world].
        velocity: its rate [m/s, world].
        heading: reference yaw [rad].
        dither: angular acceleration about x, y, z [rad/s², body] and acceleration along the thrust [m/s²].
    """

    position: Float[Array, "*t 3"]
    velocity: Float[Array, "*t 3"]
    heading: Float[Array, "*t"]
    dither: Float[Array, "*t 4"]


class Memory(eqx.Module):
    """What the pilot carries from one decision to the next: the integral of the position error [m/s², world]."""

    integral: Float[Array, "3"]


def draw_plan(key: PRNGKeyArray, steps: int) -> Plan:
    """A random plan of `steps` decisions."""
    key_targets, key_dither = jax.random.split(key)
    target, limit = _draw_waypoints(key_targets, steps)

    hardest = jnp.array(ACCELERATION)

    def follow(carry, waypoint):
        place, rate = carry
        goal, fastest = waypoint
        wanted = _shorten(1.6 * (goal - place), fastest)
        rate = rate + PERIOD * jnp.clip(5.0 * (wanted - rate), -hardest, hardest)
        place = place + PERIOD * rate
        return (place, rate), (place, rate)

    _, (place, rate) = jax.lax.scan(follow, (target[0], jnp.zeros(4)), (target, limit))
    return Plan(place[:, :3], rate[:, :3], place[:, 3], _draw_dither(key_dither, steps))


def _shorten(velocity: Float[Array, "4"], fastest: Float[Array, "3"]) -> Float[Array, "4"]:
    """Keep the direction in the plane and limit the speed in it, the climb and the turn."""
    speed = jnp.linalg.norm(velocity[:2]) + 1e-9
    plane = velocity[:2] * jnp.minimum(1.0, fastest[0] / speed)
    return jnp.concatenate([plane, jnp.clip(velocity[2:], -fastest[1:], fastest[1:])])


def _draw_waypoints(key: PRNGKeyArray, steps: int) -> tuple[Float[Array, "t 4"], Float[Array, "t 3"]]:
    """Waypoint (x, y, z, heading) and limits (cruise, climb, turn) in force at each decision."""
    count = int(steps * PERIOD / HOLD[0]) + 2
    # One draw for all: each call of a random function costs a third of a second to compile.
    draw = jax.random.uniform(key, (9, count))
    altitude = jnp.where(draw[2] < LOW_SHARE, _between(LOW, draw[3]), _between(HIGH, draw[3]))
    place = [ARENA * (2 * draw[0] - 1), ARENA * (2 * draw[1] - 1), altitude, HEADING * (2 * draw[4] - 1)]
    limit = [_between(CRUISE, draw[5]), _between(CLIMB, draw[6]), _between(TURN, draw[7])]
    departure = jnp.cumsum(_between(HOLD, draw[8]))
    current = jnp.searchsorted(departure, PERIOD * jnp.arange(steps))
    return jnp.stack(place, axis=1)[current], jnp.stack(limit, axis=1)[current]


def _between(bounds: tuple[float, float], share: Float[Array, "*n"]) -> Float[Array, "*n"]:
    return bounds[0] + (bounds[1] - bounds[0]) * share


def _draw_dither(key: PRNGKeyArray, steps: int) -> Float[Array, "t 4"]:
    share_of_band, share_of_turn = jax.random.uniform(key, (2, TONES, 4))
    frequency, phase = _between(BAND, share_of_band), 2 * jnp.pi * share_of_turn
    time = PERIOD * jnp.arange(steps)[:, None, None]
    return jnp.sqrt(2 / TONES) * jnp.array(DITHER) * jnp.sin(2 * jnp.pi * frequency * time + phase).sum(axis=1)


def act(memory: Memory, x: State, plan: Plan, nominal: Parameters, max_speed: float) -> tuple[Memory, Input]:
    """One decision: rotor speeds [rad/s] in [0, max_speed] for the plan's entry of now."""
    error = _retreat(plan.position, x[POSITION]) - x[POSITION]
    integral = jnp.clip(memory.integral + PERIOD * INTEGRAL_GAIN * error, -INTEGRAL_LIMIT, INTEGRAL_LIMIT)
    wanted = POSITION_GAIN * error + VELOCITY_GAIN * (plan.velocity - x[VELOCITY]) + integral
    climbing = _flare(wanted[2], x[POSITION][2], x[VELOCITY][2])
    lift = _limit_tilt(wanted.at[2].set(climbing + nominal.gravity), x[POSITION][2], nominal.gravity)
    spin_up = _angular_acceleration(x, lift, plan.heading) + plan.dither[:3]
    rates = x[BODY_RATES]
    torque = nominal.inertia * spin_up + jnp.cross(rates, nominal.inertia * rates)
    along_thrust = jnp.dot(lift, body_z(x[QUATERNION])) + plan.dither[3]
    thrust = nominal.mass * jnp.clip(along_thrust, 0.3 * nominal.gravity, 2.0 * nominal.gravity)
    return Memory(integral), allocate(thrust, torque, nominal, max_speed)


def _retreat(place: Float[Array, "3"], position: Float[Array, "3"]) -> Float[Array, "3"]:
    """The place to go to [m, world]: higher up for a pilot whom wind has carried off while low, and so level."""
    carried_off = jnp.linalg.norm(position[:2]) > ASTRAY
    return place.at[2].set(jnp.where(carried_off, jnp.maximum(place[2], SAFE_ALTITUDE), place[2]))


def _flare(wanted: Float[Array, ""], altitude: Float[Array, ""], climb: Float[Array, ""]) -> Float[Array, ""]:
    """At least the vertical acceleration [m/s²] that ends the descent in time, once that is no longer gentle."""
    sink = jnp.minimum(climb, 0.0)
    needed = sink**2 / (2 * jnp.maximum(altitude - CLEARANCE, 0.03))
    return jnp.where(needed > GENTLE, jnp.maximum(wanted, needed), wanted)


def _limit_tilt(lift: Float[Array, "3"], altitude: Float[Array, ""], gravity: Float[Array, ""]) -> Float[Array, "3"]:
    """Bound the asked acceleration [m/s², world] to tilts that a careful pilot dares this low, and to upward thrust."""
    up = jnp.clip(lift[2], 0.5 * gravity, 1.7 * gravity)
    lowest = jnp.arcsin(jnp.clip(DIP * altitude / ARM, 0.05, 1.0))
    sideways = jnp.linalg.norm(lift[:2]) + 1e-9
    scale = jnp.minimum(1.0, up * jnp.tan(jnp.minimum(lowest, MAX_TILT)) / sideways)
    return jnp.concatenate([lift[:2] * scale, up[None]])


def _angular_acceleration(x: State, lift: Float[Array, "3"], heading: Float[Array, ""]) -> Float[Array, "3"]:
    """Turn thrust towards lift and the nose towards heading [rad]: angular acceleration [rad/s², body]."""
    yaw = from_axis_angle(jnp.array([0.0, 0.0, 1.0]), heading)
    wanted = multiply(_shortest_turn(lift / jnp.linalg.norm(lift)), yaw)
    error = multiply(conjugate(x[QUATERNION]), wanted)
    rates = jnp.array(ATTITUDE_GAIN) * 2 * jnp.sign(error[0]) * error[1:]
    return jnp.array(RATE_GAIN) * (rates - x[BODY_RATES])


def _shortest_turn(direction: Float[Array, "3"]) -> Float[Array, "4"]:
    """The rotation that takes world z to a unit direction above the horizon."""
    dx, dy, dz = direction
    return normalise(jnp.stack([1 + dz, -dy, dx, jnp.zeros_like(dz)]))


def allocate(thrust: Float[Array, ""], torque: Float[Array, "3"], nominal: Parameters, max_speed: float) -> Input:
    """Rotor speeds [rad/s] that give a thrust [N] and a torque [N m, body], clipped to what a rotor can do."""
    k, x, y = nominal.thrust_coefficient, nominal.rotor_positions[:, 0], nominal.rotor_positions[:, 1]
    mixer = jnp.stack([k * jnp.ones(4), k * y, -k * x, nominal.torque_coefficient * nominal.spin])
    squared = jnp.linalg.solve(mixer, jnp.concatenate([thrust[None], torque]))
    return jnp.sqrt(jnp.clip(squared, 0.0, max_speed**2))


def starting_state(key: PRNGKeyArray, plan: Plan) -> State:
    """Near the start of a plan, slightly tilted, drifting and turning."""
    draw = jax.random.normal(key, (3, 3))
    level = from_axis_angle(jnp.array([0.0, 0.0, 1.0]), plan.heading[0])
    tilted = multiply(level, from_axis_angle(draw[0] / jnp.linalg.norm(draw[0]), jnp.asarray(0.05)))
    velocity = 0.3 * draw[1].at[2].set(0.0)
    return jnp.concatenate([plan.position[0], tilted, velocity, 0.3 * draw[2]])
