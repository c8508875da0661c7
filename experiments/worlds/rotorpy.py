"""Two vehicles of RotorPy in closed loop, batched: aerodynamics, motor lag and controller, written from the equations.

RotorPy: S. Folk, J. Paulos, V. Kumar, "RotorPy: A Python-based Multirotor Simulator with Aerodynamics for Education and
Research", 2023. Its values, and its derivative and commands to 1e-10 (tests/experiments/test_worlds.py). Controller:
D. Mellinger, V. Kumar, "Minimum snap trajectory generation and control for quadrotors", ICRA 2011.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from experiments.flying.changes import loaded
from experiments.worlds.world import DT, Flown, Kind, Reference, draw_reference, flown, starting_state
from hybrid_jax import rotation
from hybrid_jax.runtime import FAST_COMPILE, jit_with
from hybrid_jax.sim.flight import CLOCK
from hybrid_jax.sim.forces import Scalar
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, VELOCITY, Vehicle

SUBSTEPS = 10  # of an interval: 1 ms, a fifth of the fastest motor's lag
POSITION_GAIN, VELOCITY_GAIN = np.array([6.5, 6.5, 15.0]), np.array([4.0, 4.0, 9.0])  # 1/s², 1/s
GUST = 1.3, 0.9, 2.2  # rad/s
G, LAGGED = 9.81, 0.03  # m/s², s: the lag of a worn motor
UP = np.array([0.0, 0.0, 1.0])
Vector = Float[Array, "3"]


class Constants(NamedTuple):
    """Constants of a vehicle and its environment, body frame x forward, y left, z up; SI units.

    Attributes:
        mass: [kg].
        inertia: principal moments [kg m²].
        rotors: positions of the four rotors [m] (4, 3).
        spin: signs of their reaction torques.
        efficiency: each rotor's share of thrust and reaction torque.
        thrust: [N/(rad/s)²].
        torque: [N m/(rad/s)²].
        rotor_drag: of a rotor at its hub, along x, y (H-force) and z (inflow), per its speed [kg/rad].
        lift: translational, of a rotor [kg/m].
        flapping: moment of a rotor per its speed and the air's [kg m/rad].
        parasitic: drag of the frame [kg/m].
        lag: of the motors [s].
        fastest: rotor speed [rad/s].
        stiffness: of the attitude controller [1/s²].
        damping: of the attitude controller [1/s].
        reached: share of the commanded speed that a motor reaches.
        wind: mean [m/s, world].
        gust: amplitude of a sine in each direction [m/s].
    """

    mass: float
    inertia: tuple[float, float, float]
    rotors: np.ndarray
    spin: tuple[float, ...]
    efficiency: tuple[float, ...]
    thrust: float
    torque: float
    rotor_drag: tuple[float, float, float]
    lift: float
    flapping: float
    parasitic: tuple[float, float, float]
    lag: float
    fastest: float
    stiffness: float
    damping: float
    reached: float = 1.0
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gust: tuple[float, float, float] = (0.0, 0.0, 0.0)


def _square(arm: float) -> np.ndarray:
    """Return four rotors on the diagonals: front left, front right, back right, back left."""
    return arm / np.sqrt(2) * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])


SPIN, WHOLE = (1.0, -1.0, 1.0, -1.0), (1.0, 1.0, 1.0, 1.0)
HUMMINGBIRD = Constants(
    0.5, (3.65e-3, 3.68e-3, 7.03e-3), _square(0.17), SPIN, WHOLE, 5.57e-6, 1.36e-7, (1.19e-4, 1.19e-4, 2.32e-4),
    3.39e-3, 0.0, (5e-3, 5e-3, 1e-2), 0.005, 1500.0, 544.0, 46.64,
)  # fmt: skip
CRAZYFLIE = Constants(
    0.03, (1.43e-5, 1.43e-5, 2.89e-5), _square(0.043), SPIN, WHOLE, 2.3e-8, 7.8e-10, (1.02506e-6, 1.02506e-6, 7.553e-7),
    0.0, 0.0, (0.0, 0.0, 0.0), 0.072, 2500.0, 310.0, 57.0,
)  # fmt: skip


def derivative(
    c: Constants, x: Float[Array, "13"], speeds: Float[Array, "4"], command: Float[Array, "4"], wind: Vector
) -> tuple[Float[Array, "13"], Float[Array, "4"]]:
    """Return derivatives of state and rotor speeds, for commanded speeds [rad/s] and a wind [m/s, world]."""
    q, rates, inertia, rotors = x[QUATERNION], x[BODY_RATES], jnp.asarray(c.inertia), jnp.asarray(c.rotors)
    up = jnp.array(UP.tolist())  # after a program in double precision, JAX takes an array of NumPy for float64
    air = rotation.rotate(rotation.conjugate(q), x[VELOCITY] - wind)
    hubs = air + jnp.cross(rates, rotors)
    lift = jnp.asarray(c.efficiency) * c.thrust * speeds**2 + c.lift * jnp.sum(hubs[:, :2] ** 2, axis=1)
    forces = lift[:, None] * up - speeds[:, None] * jnp.asarray(c.rotor_drag) * hubs
    force = forces.sum(axis=0) - jnp.linalg.norm(air) * jnp.asarray(c.parasitic) * air
    moment = jnp.cross(rotors, forces) - c.flapping * speeds[:, None] * jnp.cross(hubs, up)
    reaction = c.torque * jnp.sum(jnp.asarray(c.spin) * jnp.asarray(c.efficiency) * speeds**2)
    turning = (moment.sum(axis=0) + reaction * up - jnp.cross(rates, inertia * rates)) / inertia
    acceleration = rotation.rotate(q, force) / c.mass - G * up
    slopes = x[VELOCITY], rotation.derivative(q, rates), acceleration, turning
    return jnp.concatenate(slopes), (command - speeds) / c.lag


def decide(c: Constants, x: Float[Array, "13"], now: Reference) -> Float[Array, "4"]:
    """Return the controller's commanded rotor speeds, for a vehicle with these constants [rad/s]."""
    wanted = POSITION_GAIN * (now.position - x[POSITION]) + VELOCITY_GAIN * (now.velocity - x[VELOCITY])
    lift = c.mass * (wanted + now.acceleration + G * UP)
    attitude = jnp.array(rotation.matrix(x[QUATERNION]))
    z = lift / jnp.linalg.norm(lift)
    y = jnp.cross(z, jnp.stack([jnp.cos(now.heading), jnp.sin(now.heading), jnp.zeros_like(now.heading)]))
    y = y / jnp.linalg.norm(y)
    aim = jnp.stack([jnp.cross(y, z), y, z], axis=1)
    off = (aim.T @ attitude - attitude.T @ aim) / 2
    error, rates, inertia = jnp.stack([off[2, 1], off[0, 2], off[1, 0]]), x[BODY_RATES], jnp.asarray(c.inertia)
    moment = inertia * (-c.stiffness * error - c.damping * (rates - now.turn * UP)) + jnp.cross(rates, inertia * rates)
    places, ratio = jnp.asarray(c.rotors), c.torque / c.thrust * jnp.asarray(c.spin)
    mixer = jnp.stack([jnp.ones(4), places[:, 1], -places[:, 0], ratio])
    squares = jnp.linalg.solve(mixer, jnp.concatenate([jnp.dot(lift, attitude[:, 2])[None], moment])) / c.thrust
    return jnp.sign(squares) * jnp.sqrt(jnp.abs(squares))


def advance(c: Constants, x, speeds, command, t: Scalar):
    """Return state and rotor speeds after an interval with the command held (RK4), and the mean speeds in it."""
    h = DT / SUBSTEPS

    def slope(state, t):
        x, speeds = state
        wind = jnp.asarray(c.wind) + jnp.asarray(c.gust) * jnp.sin(jnp.array(GUST) * t)
        return derivative(c, x, speeds, command, wind)

    def step(state, t):
        def along(slopes, fraction):
            return jax.tree.map(lambda a, b: a + fraction * h * b, state, slopes)

        k1 = slope(state, t)
        k2 = slope(along(k1, 0.5), t + h / 2)
        k3 = slope(along(k2, 0.5), t + h / 2)
        k4 = slope(along(k3, 1.0), t + h)
        x, speeds = jax.tree.map(lambda s, a, b, c, d: s + h / 6 * (a + 2 * (b + c) + d), state, k1, k2, k3, k4)
        return (x.at[QUATERNION].set(rotation.normalise(x[QUATERNION])), speeds), (state[1] + speeds) / 2

    state, speeds = jax.lax.scan(step, (x, speeds), t + h * jnp.arange(SUBSTEPS))
    return state, speeds.mean(axis=0)


@dataclass(frozen=True, eq=False)
class RotorPy:
    """A vehicle of RotorPy, with nominal constants before a change; see `World`."""

    name: str
    nominal: Constants

    @property
    def vehicle(self) -> Vehicle:
        return _vehicle(self.name, self.nominal)

    def changed(self, change: str) -> Vehicle:
        return _vehicle(self.name, self.truth(change))

    def truth(self, change: str) -> Constants:
        c, (ix, iy, iz) = self.nominal, self.nominal.inertia
        arm = float(np.abs(c.rotors).max())
        load = loaded(self.vehicle, 0.2 * c.mass, (0.2 * arm, 0.15 * arm, -0.25 * arm))
        wind, slanted = {"wind": (2.0, -4.0, 0.5)}, {"wind": (2.0, -2.5, 0.6), "gust": (1.0, 1.2, 0.4)}
        places = np.pad(np.asarray(load.rotor_positions), ((0, 0), (0, 1)))
        off_centre = {"mass": load.mass, "inertia": load.inertia, "rotors": places}
        drag = {name: tuple(2 * each for each in getattr(c, name)) for name in ("rotor_drag", "parasitic")}
        changes: Mapping[str, Mapping[str, Any]] = {
            "nothing": {},
            "parameter_shift": {"inertia": (1.37 * ix, 0.69 * iy, iz)},
            "external_force": wind,
            "doubled_drag": drag,
            "weak_rotor": {"efficiency": (0.85, 1.0, 1.0, 1.0)},
            "off_centre_load": off_centre,
            "gusty_wind": slanted,
            "load_and_wind": off_centre | wind,
            "reaction_torque": {"torque": 1.6 * c.torque},
            "motor_lag": {"lag": max(LAGGED, 1.3 * c.lag)},
            "battery": {"reached": 0.9},
        }
        return c._replace(**changes[change])

    def fly(self, change: str, kind: str, flights: int, seconds: float, key: PRNGKeyArray) -> Flown:
        given = (Constants(*map(np.asarray, each)) for each in (self.truth(change), self.nominal))  # type: ignore
        return flown(partial(_fly, *given), kind, flights, seconds, key)


def _vehicle(name: str, c: Constants) -> Vehicle:
    places = tuple(map(tuple, c.rotors[:, :2].tolist()))
    return Vehicle(c.mass, c.inertia, c.thrust, c.torque, places, c.spin, c.fastest, gravity=G, name=name)


ROTORPY = (RotorPy("hummingbird", HUMMINGBIRD), RotorPy("crazyflie", CRAZYFLIE))


@jit_with(FAST_COMPILE)
def _fly(truth: Constants, nominal: Constants, kind: Kind, steps: int, keys: PRNGKeyArray):
    """Return states, and rotor speeds at the start of each interval and on average, of a flight for each key."""

    def one(key: PRNGKeyArray):
        reference = draw_reference(key, kind, steps)
        x = starting_state(reference)

        def interval(carry, now):
            (x, speeds), t = carry
            command = truth.reached * jnp.clip(decide(nominal, x, now), 0.0, nominal.fastest)
            state, mean = advance(truth, x, speeds, command, t)
            return (state, t + DT), (state[0], speeds, mean)

        hover = jnp.full(4, jnp.sqrt(nominal.mass * G / 4 / nominal.thrust))
        start = (x, hover), CLOCK * jax.random.uniform(key)
        _, (states, sampled, averaged) = jax.lax.scan(interval, start, reference)
        return jnp.concatenate([x[None], states]), sampled, averaged

    return jax.vmap(one)(keys)
