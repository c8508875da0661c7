"""The project's own simulator as a world."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from experiments.flying import changes
from experiments.worlds.world import DT, Flown, Kind, draw_reference, flown, starting_state
from hybrid_jax.dynamics.batching import like
from hybrid_jax.runtime import FASTEST_COMPILE, jit_with
from hybrid_jax.sim import SOURCE, Domain, Quadrotor, pilot
from hybrid_jax.sim.flight import CLOCK
from hybrid_jax.sim.forces import Parameters, Scalar, parameters_of
from hybrid_jax.vehicle import IRIS, Vehicle

REACTION = Domain("reaction_torque", replace(IRIS, torque_coefficient=1.6 * IRIS.torque_coefficient), nominal=IRIS)
DOMAINS = {domain.name: domain for domain in (*changes.CHANGES, REACTION)}
MOTORS = {"motor_lag": (0.03, 1.0), "battery": (0.0, 0.9)}  # lag [s], share of the commanded speed that is reached
AT_ONCE = 1e-9  # s


def domain_of(change: str) -> Domain:
    return DOMAINS.get(change, SOURCE)


@dataclass(frozen=True)
class Iris:
    """The Iris of `hybrid_jax.sim`, whose inputs are held over each interval; see `World`."""

    name: str = "iris"
    vehicle: Vehicle = IRIS

    def changed(self, change: str) -> Vehicle:
        return domain_of(change).vehicle

    def fly(self, change: str, kind: str, flights: int, seconds: float, key: PRNGKeyArray) -> Flown:
        domain = domain_of(change)
        lag, reached = MOTORS.get(change, (0.0, 1.0))

        def fly(flight: Kind, steps: int, keys: PRNGKeyArray):
            vehicles = domain.quadrotor(), parameters_of(IRIS)
            motors = jnp.exp(-DT / max(lag, AT_ONCE)), jnp.asarray(reached)
            return _fly(*vehicles, *motors, flight, kind == "moving", steps, keys)

        return flown(fly, kind, flights, seconds, key)


@jit_with(FASTEST_COMPILE)
def _fly(
    truth: Quadrotor,
    nominal: Parameters,
    kept: Scalar,
    reached: Scalar,
    kind: Kind,
    random: bool,
    steps: int,
    keys: PRNGKeyArray,
):
    """Return states, and twice the rotor speeds, of flights; in an interval rotors retain a share of their speed."""
    scale = pilot.scale_of(IRIS)

    def one(key: PRNGKeyArray):
        own, start = jax.random.split(key)
        reference = draw_reference(own, kind, steps)
        no_dither = jnp.zeros((steps, 4))
        course = pilot.Course(reference.position, reference.velocity, reference.heading, no_dither)
        x = starting_state(reference)
        if random:
            course = pilot.draw_course(steps, scale, own)
            x = pilot.starting_state(course, scale, start)

        def interval(carry, now):
            integral, x, u, t = carry
            integral, command = pilot.act(integral, x, now, nominal, IRIS, scale)
            u = kept * u + (1 - kept) * reached * command
            x = truth.step(x, u, t, DT)
            return (integral, x, u, t + DT), (x, u)

        hover = jnp.full(4, IRIS.hover_speed) + like(jnp.zeros(4), x)
        begun = like(jnp.zeros(3), x), x, hover, CLOCK * jax.random.uniform(start)
        _, (states, u) = jax.lax.scan(interval, begun, course)
        return jnp.concatenate([x[None], states]), u, u

    return jax.vmap(one)(keys)
