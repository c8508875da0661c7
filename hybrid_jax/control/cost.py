"""Cost of a plan: weighted deviations from a reference, and a penalty on the rate of the inputs."""

from dataclasses import dataclass, fields

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.rotation import attitude_error
from hybrid_jax.vehicle import BODY_RATES, POSITION, QUATERNION, VELOCITY, State

Scalar = Float[Array, ""]


@dataclass(frozen=True)
class Weights:
    """Weights of cost = Σ (weight × deviation)²; a deviation of 1 / weight costs 1.

    In a steady wind or with a wrong k, tilt and rotor speeds must differ from their reference. Tilt should therefore
    cost little, and only changes of rotor speeds cost; otherwise position errors would grow.

    Attributes:
        position: weight of the distance [1/m].
        tilt: weight of the attitude error about the body's x and y axes [1/rad].
        yaw: weight of the attitude error about the body's z axis [1/rad].
        velocity: weight of the velocity error [s/m].
        body_rates: weight of the body rates' error [s/rad].
        change: weight of the change of a rotor speed between intervals, as a share of half its range.
        terminal: factor on all deviations of the last state of the horizon.

    Raises:
        ValueError: if a weight is negative or not finite, or `position`, `yaw` or `change` is zero.
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
    """Weight the deviations of a state from its reference: position, attitude, velocity, body rates."""
    difference = x[: len(reference)] - reference  # a model may have hidden states behind these
    attitude = jnp.array([weights.tilt, weights.tilt, weights.yaw], x.dtype)
    attitude = attitude * attitude_error(reference[QUATERNION], x[QUATERNION])
    velocity, rates = weights.velocity * difference[VELOCITY], weights.body_rates * difference[BODY_RATES]
    return jnp.concatenate([weights.position * difference[POSITION], attitude, velocity, rates])


def stage_factors(weights: Weights, steps: int) -> Float[np.ndarray, " t"]:
    """Return the factor on the deviations of each state of the horizon."""
    return np.append(np.ones(steps - 1, np.float32), np.float32(weights.terminal))


def plan_cost(
    weights: Weights, reference: Float[Array, "t 13"], x: Float[Array, "t 13"], share: Float[Array, "t 4"]
) -> Scalar:
    """Compute the cost of inputs (shares −1 … 1 of their range) and of the resulting states x."""
    weighted = jax.vmap(lambda wanted, found: deviations(weights, wanted, found))(reference, x)
    tracking = jnp.sum(jnp.square(stage_factors(weights, len(x))[:, None] * weighted))
    return tracking + jnp.sum(jnp.square(weights.change * jnp.diff(share, axis=0)))


def input_rate_penalty(weights: Weights, steps: int) -> Float[np.ndarray, "t t"]:
    """Return the matrix M for which the changes of one rotor's shares s cost sᵀ M s."""
    differences = weights.change * np.diff(np.eye(steps, dtype=np.float32), axis=0)
    return differences.T @ differences
