"""The interface of a world, its references, and the logs of its vehicle."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from experiments.flying import changes
from experiments.paper.conditions import measure, sensor_noise
from hybrid_jax.rotation import from_axis_angle
from hybrid_jax.trajectories import Trajectories, concatenate, windows_of
from hybrid_jax.vehicle import Vehicle

DT = 0.01  # s, a decision of the pilot and an interval of the log
SETTLING = 3.0  # s, flown before the log begins: after a second some vehicles still turn over
TONES = 3
BURST, WILD = slice(400, 430), 50.0  # samples of an outlier burst, and how many times the usual noise they have
MADE_FOR = (*(domain.name for domain in changes.CHANGES), "reaction_torque")
NOTHING, USUAL = "nothing", "moving"
NOT_MADE_FOR = (NOTHING, "motor_lag", "battery")  # no candidate can express them
CHANGES = (*MADE_FOR, *NOT_MADE_FOR)


class Kind(NamedTuple):
    """A kind of flight: sines about a place.

    Attributes:
        acceleration: rms of the reference's in the plane; half of it vertically [m/s²].
        slowest: sine [Hz].
        fastest: sine [Hz].
        altitude: mean [m].
        turning: amplitude of the heading [rad].
    """

    acceleration: float
    slowest: float
    fastest: float
    altitude: float
    turning: float


KINDS = {
    "moving": Kind(2.0, 0.15, 0.8, 4.0, 0.8),
    "lively": Kind(1.2, 1.0, 2.0, 4.0, 0.1),
    "hover": Kind(0.03, 0.2, 0.6, 2.0, 0.01),
    "near_ground": Kind(0.05, 0.05, 0.12, 0.3, 0.1),
}


class Reference(NamedTuple):
    """The reference at each decision, in the world frame; SI units."""

    position: Float[Array, "*t 3"]
    velocity: Float[Array, "*t 3"]
    acceleration: Float[Array, "*t 3"]
    heading: Float[Array, "*t"]
    turn: Float[Array, "*t"]


class Flown(NamedTuple):
    """n flights of t intervals: true states at their ends, and each rotor's speed [rad/s] at their start and mean."""

    states: Float[np.ndarray, "n t+1 13"]
    sampled: Float[np.ndarray, "n t 4"]
    averaged: Float[np.ndarray, "n t 4"]


class World(Protocol):
    """A true vehicle that can be changed and flown."""

    @property
    def name(self) -> str:
        """The label in reports."""
        ...

    @property
    def vehicle(self) -> Vehicle:
        """The user's known constants before a change."""
        ...

    def changed(self, change: str) -> Vehicle:
        """The constants after one of `CHANGES`."""
        ...

    def fly(self, change: str, kind: str, flights: int, seconds: float, key: PRNGKeyArray) -> Flown:
        """Fly one of `KINDS` after one of `CHANGES`; the pilot uses the vehicle before it."""
        ...


def draw_reference(key: PRNGKeyArray, kind: Kind, steps: int) -> Reference:
    shares = jax.random.uniform(key, (2, TONES, 4))
    omega = 2 * jnp.pi * (kind.slowest + (kind.fastest - kind.slowest) * shares[0])
    size = np.sqrt(2 / TONES) * kind.acceleration * np.array([1.0, 1.0, 0.5, 0.0]) / omega**2
    size = size.at[:, 3].set(kind.turning / TONES)
    angle = omega * DT * jnp.arange(steps)[:, None, None] + 2 * jnp.pi * shares[1]
    place = jnp.sum(size * jnp.sin(angle), axis=1)
    rate = jnp.sum(size * omega * jnp.cos(angle), axis=1)
    bend = -jnp.sum(size * omega**2 * jnp.sin(angle), axis=1)
    home = jnp.array([0.0, 0.0, kind.altitude])
    return Reference(place[:, :3] + home, rate[:, :3], bend[:, :3], place[:, 3], rate[:, 3])


def starting_state(reference: Reference) -> Float[Array, "13"]:
    level = from_axis_angle(jnp.array([0.0, 0.0, 1.0]), reference.heading[0])
    return jnp.concatenate([reference.position[0], level, reference.velocity[0], jnp.zeros(3)])


def flown(fly: Callable[[Kind, int, PRNGKeyArray], Any], kind: str, flights: int, seconds: float, key) -> Flown:
    """Run `fly(kind, steps, keys)` with a key for each flight, in float64, after the flights have settled."""
    settling = round(SETTLING / DT)
    with jax.enable_x64(True):
        parts = fly(
            jax.tree.map(np.asarray, KINDS[kind]), settling + round(seconds / DT), jax.random.split(key, flights)
        )
    return Flown(*(np.asarray(part)[:, settling:] for part in jax.device_get(parts)))


def logged(
    flights: Flown, key: PRNGKeyArray, steps: int, *, noise: float = 1.0, averaged: bool = True, burst: bool = False
) -> Trajectories:
    """Return consecutive windows of `steps` intervals of the logs of all flights.

    `noise` 1 is typical, 0 gives the truth; rotor speeds are `averaged` or sampled; a `burst` is some outliers.
    """

    def with_noise(states: np.ndarray, level: float, key: PRNGKeyArray) -> np.ndarray:
        return np.array(measure(jnp.asarray(states, jnp.float32), sensor_noise(level), key))

    parts = []
    for i, states in enumerate(flights.states):
        own = jax.random.fold_in(key, i)
        log = with_noise(states, noise, own) if noise else states.astype(np.float32)
        if burst:
            log[BURST] = with_noise(states[BURST], WILD * noise, own)
        speeds = (flights.averaged if averaged else flights.sampled)[i].astype(np.float32)
        parts.append(windows_of(log, speeds, DT, steps=steps))
    return concatenate(parts)
