"""Cost of a plan: weighted deviations from a reference, and a penalty on the rate of the inputs."""

from dataclasses import dataclass, fields

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.rotation import attitude_error
from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY, State

Scalar = Float[Array, ""]


@dataclass(frozen=True)
class Weights:
    """Weights of cost = Σ (weight × deviation)²; a deviation of 1 / weight costs 1.

    Tilt and rotor speed must differ from their reference in a steady wind or under an error of k. Tilt therefore costs
    little, and of rotor speeds only the changes cost; otherwise position would pay for it.

    Attributes:
        position: of the distance [1/m].
        tilt: of the attitude error about the body's x and y axes [1/rad].
        yaw: of the attitude error about the body's z axis [1/rad].
        velocity: of the velocity's error [s/m].
        body_rates: of the body rates' error [s/rad].
        change: of a rotor's speed from one interval to the next, as a share of half its range.
        terminal: factor on all deviations of the last state of the horizon.

    Raises:
        ValueError: a weight is negative or not finite, or `position`, `yaw` or `change` is zero.
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
    """Weighted deviations of a state from its reference: position, attitude, velocity, body rates."""
    difference = x - reference
    attitude = jnp.array([weights.tilt, weights.tilt, weights.yaw], x.dtype)
    attitude = attitude * attitude_error(reference[QUATERNION], x[QUATERNION])
    velocity, rates = weights.velocity * difference[VELOCITY], weights.body_rates * difference[BODY_RATES]
    return jnp.concatenate([weights.position * difference[POSITION], attitude, velocity, rates])


def stage_factors(weights: Weights, steps: int) -> Float[np.ndarray, " t"]:
    """Factor on the deviations of each state of the horizon."""
    return np.append(np.ones(steps - 1, np.float32), np.float32(weights.terminal))


def plan_cost(
    weights: Weights, reference: Float[Array, "t 13"], x: Float[Array, "t 13"], share: Float[Array, "t 4"]
) -> Scalar:
    """Cost of inputs (shares −1 … 1 of their range) and of the states x that they lead to."""
    weighted = jax.vmap(lambda wanted, found: deviations(weights, wanted, found))(reference, x)
    tracking = jnp.sum(jnp.square(stage_factors(weights, len(x))[:, None] * weighted))
    return tracking + jnp.sum(jnp.square(weights.change * jnp.diff(share, axis=0)))


def input_rate_penalty(weights: Weights, steps: int) -> Float[np.ndarray, "t t"]:
    """Matrix M such that the changes of one rotor's shares s cost sᵀ M s."""
    differences = weights.change * np.diff(np.eye(steps, dtype=np.float32), axis=0)
    return differences.T @ differences
