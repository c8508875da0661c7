"""A multirotor and its sensors as a model of records, see `estimation.record_fit`."""

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import rotation
from hybrid_jax.dynamics.actuators import Actuated, held_means
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.state_space import Quantity
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, STATE_SIZE, VELOCITY

PUSHED = tuple(range(VELOCITY.start, STATE_SIZE))  # the states that a constant disturbance acts on
TANGENT = RIGID_BODY_SPACE.tangent_size
STATES = {"position": POSITION, "attitude": QUATERNION, "velocity": VELOCITY, "rates": BODY_RATES}
MEASURED = (*STATES, "body_velocity", "specific_force", "rotor_speed")


@dataclass(frozen=True)
class Settled(Quantity):
    """Numbers that follow from the inputs before a window, so that a search does not change them."""

    @property
    def tangent_size(self) -> int:
        return 0

    def retract(self, x, change):
        return x

    def difference(self, y, x):
        return y[:0]


class Multirotor(eqx.Module):
    """A body, its rotors' speeds if they lag, and a constant disturbance of v̇ and ω̇, as a `StateSpaceModel`."""

    field: Any  # with the disturbance as a hidden part
    axes: dict[str, tuple[int, ...]] = eqx.field(static=True)  # the measured axes of each compared quantity
    ahead: int = eqx.field(static=True)  # intervals of inputs before a window, from which rotor speeds follow

    @property
    def rotor_states(self) -> int:
        body = self.field.field
        return body.rotor_states if isinstance(body, Actuated) else 0

    @property
    def space(self):
        rotors = (Settled("rotor speeds", n),) if (n := self.rotor_states) else ()
        own = *RIGID_BODY_SPACE.quantities, *rotors, Quantity("disturbance", len(PUSHED))
        return replace(RIGID_BODY_SPACE, quantities=own)

    def begin(self, x0, u, dt):
        body = self.field.field
        if isinstance(body, Actuated):
            if "delay" in body.deviations or body.actuator.delay:
                edges = dt * np.arange(len(u) + 1)
                u = held_means(jnp.asarray(edges[:-1]), u, edges, body.delay)
            if n := self.rotor_states:
                speeds = body.settled(u[: max(self.ahead, 1)], dt)
                x0 = x0.at[STATE_SIZE : STATE_SIZE + n].set(speeds)
        return x0, u[self.ahead :]

    def output(self, name, x, u):
        rotors = self.field.field, x[: len(x) - len(PUSHED)]
        return measure(name, *(rotors if name == "rotor_speed" else (self.field, x)), u)[np.array(self.axes[name])]

    def error(self, name, predicted, y):
        return -rotation.attitude_error(predicted, jnp.asarray(y)) if name == "attitude" else predicted - y


def measure(
    quantity: str, field: AbstractVectorField, x: Float[Array, " d"], u: Float[Array, " m"], gravity: float = 9.81
) -> Float[Array, " k"]:
    """Return one of `MEASURED`, with the axes of `recording.AXES`; the specific force is Rᵀ (v̇ + g e_z) [m/s²]."""
    if quantity in STATES:
        return x[STATES[quantity]]
    if quantity == "rotor_speed":
        return field.speeds(x, u)  # pyright: ignore[reportAttributeAccessIssue]
    vector = x[VELOCITY] if quantity == "body_velocity" else field(x, u)[VELOCITY].at[2].add(gravity)
    return rotation.rotate(rotation.conjugate(rotation.normalise(x[QUATERNION])), vector)
