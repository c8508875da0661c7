"""What a plan of inputs costs: weighted deviations from a reference, and the input's unrest."""

from dataclasses import dataclass, fields

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.control.attitude import attitude_error
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY, State

Scalar = Float[Array, ""]


@dataclass(frozen=True)
class Weights:
    """A deviation of 1 / weight costs 1; cost = Σ (weight × deviation)².

    What must differ from its reference in a steady wind or with a wrong k, tilt and rotor speed, costs little or only
    by its changes; else position would pay for it.

    Attributes:
        position: [1/m].
        tilt: of the attitude error about body x and y [1/rad].
        yaw: of the attitude error about body z [1/rad].
        velocity: [s/m].
        body_rates: [s/rad].
        change: of a rotor's speed from one interval to the next, as a share of half the range between its limits.
        terminal: factor on all deviations of the last state of the horizon.

    Raises:
        ValueError: a weight that is negative or not finite; a position, a yaw or a change that costs nothing.
    """

    position: float = 10.0
    tilt: float = 0.3
    yaw: float = 3.0
    velocity: float = 1.5
    body_rates: float = 0.3
    change: float = 1.0
    terminal: float = 3.0

    def __post_init__(self):
        for field in fields(self):
            required = field.name in ("position", "yaw", "change")
            (checks.positive if required else checks.not_negative)(field.name, getattr(self, field.name))


def deviations(weights: Weights, reference: State, x: State) -> Float[Array, "12"]:
    """Weighted deviations of one state from its reference: position, attitude, velocity, body rates."""
    turn = attitude_error(reference[QUATERNION], x[QUATERNION])
    away = x - reference
    return jnp.concatenate(
        [
            weights.position * away[POSITION],
            jnp.array([weights.tilt, weights.tilt, weights.yaw], x.dtype) * turn,
            weights.velocity * away[VELOCITY],
            weights.body_rates * away[BODY_RATES],
        ]
    )


def stage_factors(weights: Weights, steps: int) -> Float[np.ndarray, " t"]:
    """Factor on the deviations of each state of the horizon."""
    return np.append(np.ones(steps - 1, np.float32), np.float32(weights.terminal))


def plan_cost(
    weights: Weights, reference: Float[Array, "t 13"], x: Float[Array, "t 13"], share: Float[Array, "t 4"]
) -> Scalar:
    """The cost of inputs (shares −1 … 1 of their range) and the states that they lead to."""
    apart = jax.vmap(lambda wanted, found: deviations(weights, wanted, found))(reference, x)
    tracking = jnp.sum(jnp.square(stage_factors(weights, len(x))[:, None] * apart))
    return tracking + jnp.sum(jnp.square(weights.change * jnp.diff(share, axis=0)))


def unrest(weights: Weights, steps: int) -> Float[np.ndarray, "t t"]:
    """M such that the changes of one rotor's shares s cost sᵀ M s."""
    differences = weights.change * np.diff(np.eye(steps, dtype=np.float32), axis=0)
    return differences.T @ differences
