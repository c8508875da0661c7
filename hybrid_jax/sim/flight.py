"""Random flights of a domain: the pilot and the true vehicle in closed loop."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from hybrid_jax import checks
from hybrid_jax.runtime import FASTEST_COMPILE
from hybrid_jax.sim import pilot
from hybrid_jax.sim.domain import Domain
from hybrid_jax.sim.forces import Parameters, parameters_of, rotor_altitudes
from hybrid_jax.sim.quadrotor import CHUNK, Quadrotor
from hybrid_jax.state import POSITION, VELOCITY
from hybrid_jax.vehicle import IRIS, Vehicle

DT = pilot.PERIOD  # s
CLOCK = 60.0  # s: flights start at a random time in [0, CLOCK), at any phase of the wind

# Bounds of a sound flight of the Iris; those of other vehicles are scaled.
MAX_DISTANCE, MAX_ALTITUDE, MAX_SPEED = 20.0, 10.0, 15.0  # m from home in the plane, m, m/s


class Flights(NamedTuple):
    """n flights of t decisions, float64."""

    states: Float[Array | np.ndarray, "*n t+1 13"]
    inputs: Float[Array | np.ndarray, "*n t 4"]  # held from one state to the next [rad/s]
    lowest_rotor: Float[Array | np.ndarray, "*n t+1"]  # altitude [m]
    start: Float[Array | np.ndarray, "*n"]  # time of the first state [s]


def fly(domain: Domain, flights: int, seconds: float, key: PRNGKeyArray) -> Flights:
    """Simulate random closed-loop flights of `seconds` each, at 100 Hz, always in float64 and on the CPU.

    Flight i depends on the key and i alone.

    Raises:
        ValueError: flights or seconds are not positive, or key is not a random key.
    """
    checks.count("flights", flights)
    checks.positive("seconds", seconds)
    checks.key("key", key)
    steps = round(seconds / DT)
    checks.count(f"intervals of {DT} s in seconds={seconds}", steps)
    cpu = jax.devices("cpu")[0]
    with jax.enable_x64(True), jax.default_device(cpu):
        truth = domain.quadrotor()
        keys = jax.vmap(partial(jax.random.fold_in, jax.device_put(key, cpu)))(jnp.arange(-(-flights // CHUNK) * CHUNK))
        # Chunks of one size share one compilation.
        nominal = parameters_of(domain.nominal)
        parts = [_fly_chunk(truth, nominal, chunk, steps, domain.nominal) for chunk in keys.reshape(-1, CHUNK)]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:flights], *jax.device_get(parts))


@partial(jax.jit, static_argnames=("steps", "vehicle"), compiler_options=FASTEST_COMPILE)
def _fly_chunk(truth: Quadrotor, nominal: Parameters, keys: Key[Array, " n"], steps: int, vehicle: Vehicle) -> Flights:
    scale = pilot.scale_of(vehicle)

    def one_flight(key: PRNGKeyArray) -> Flights:
        key_plan, key_start, key_clock = jax.random.split(key, 3)
        plan = pilot.draw_plan(key_plan, steps, scale)
        x0 = pilot.starting_state(key_start, plan, scale)
        start = jax.random.uniform(key_clock, maxval=CLOCK)

        def decide(carry, now):
            integral, x, t = carry
            integral, u = pilot.act(integral, x, now, nominal, vehicle.max_rotor_speed, scale)
            x = truth.step(x, u, t, DT)
            return (integral, x, t + DT), (x, u)

        _, (x, u) = jax.lax.scan(decide, (jnp.zeros(3), x0, start), plan)
        states = jnp.concatenate([x0[None], x])
        altitudes = jax.vmap(rotor_altitudes, in_axes=(0, None))(states, truth.parameters.rotor_positions)
        return Flights(states, u, altitudes.min(axis=1), start)

    return jax.vmap(one_flight)(keys)


def gone_wrong(states: Float[Array | np.ndarray, "n t 13"], vehicle: Vehicle = IRIS) -> np.ndarray:
    """Which flights (n,) of a vehicle diverged, left the arena, were too fast or crashed."""
    scale = pilot.scale_of(vehicle)
    place, altitude = states[..., POSITION][..., :2], states[..., POSITION][..., 2]
    far = np.linalg.norm(place, axis=-1) > MAX_DISTANCE * scale.length
    fast = np.linalg.norm(states[..., VELOCITY], axis=-1) > MAX_SPEED * scale.speed
    outside = (altitude > MAX_ALTITUDE * scale.length) | (altitude < 0)
    return (far | fast | outside | ~np.isfinite(states).all(axis=-1)).any(axis=1)
