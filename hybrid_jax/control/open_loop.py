"""Open-loop cost of the controller's plans: predicted by its model, and measured in the plant.

Feedback hides the errors of a model. A plan that runs to its end without another call shows them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.control.controller import Controller
from hybrid_jax.control.cost import Scalar, plan_cost
from hybrid_jax.control.loop import Flight, Plant


class OpenLoopCosts(NamedTuple):
    """Costs of the plans of some calls of a flight."""

    predicted: Float[Array, " c"]  # by the controller's model
    actual: Float[Array, " c"]  # of the same inputs in the plant


def open_loop_costs(
    plant: Plant, flight: Flight, reference: Float[Array, "n 13"], controller: Controller, calls: Sequence[int]
) -> OpenLoopCosts:
    """Predicted and actual open-loop cost of the plans of these calls."""

    def advance(x, inputs):
        x = plant(x, *inputs)
        return x, x

    def actual_cost(i: Scalar) -> Scalar:
        plan = jax.tree.map(lambda leaf: leaf[i], flight.plans)
        speeds = jnp.repeat(controller.speeds(plan), controller.stride, axis=0)
        times = controller.period * (i + jnp.arange(len(speeds)))
        states = jax.lax.scan(advance, flight.x[i], (speeds, times))[1][controller.stride - 1 :: controller.stride]
        return plan_cost(controller.weights, controller.horizon(reference, i), states, jnp.tanh(plan.variables))

    chosen = jnp.asarray(calls)
    return OpenLoopCosts(flight.plans.cost[chosen], jax.vmap(actual_cost)(chosen))


def relative_cost_error(costs: OpenLoopCosts, controller: Controller, distance: float = 0.005) -> Float[Array, ""]:
    """(actual − predicted) / predicted, each summed over the calls.

    The denominator is at least the cost of plans that stay `distance` [m] from the reference, because near zero the
    ratio means nothing.

    Raises:
        ValueError: `distance` is not positive.
    """
    checks.positive("distance", distance)
    weights = controller.weights
    floor = (controller.steps - 1 + weights.terminal**2) * (weights.position * distance) ** 2
    error = jnp.sum(costs.actual) - jnp.sum(costs.predicted)
    return error / jnp.maximum(jnp.sum(costs.predicted), floor * len(costs.predicted))
