"""What a controller promised and what came of it: its plans, rolled open loop in the plant.

Feedback hides a model's errors, for the next call corrects them; the plan of one call, flown to its end without
another, shows them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.control.controller import Controller
from hybrid_jax.control.loop import Flight, Plant, realised

NEAR = 0.005  # m: a promise to stay nearer than this throughout counts as one to be this far off


class Promises(NamedTuple):
    """Costs of the plans of some calls of a flight.

    Attributes:
        promised: by the controller's model.
        realised: of the same inputs in the plant.
    """

    promised: Float[Array, " c"]
    realised: Float[Array, " c"]


def promises(
    plant: Plant, flight: Flight, reference: Float[Array, "n 13"], controller: Controller, calls: Sequence[int]
) -> Promises:
    """The promised and the realised costs of these calls."""
    chosen = jnp.asarray(calls)
    realise = jax.vmap(lambda i: realised(plant, flight, reference, controller, i))
    return Promises(flight.plans.cost[chosen], realise(chosen))


def least_promise(controller: Controller, distance: float = NEAR) -> float:
    """What it costs to be so far [m] from the reference at every state of the horizon.

    Raises:
        ValueError: a distance that is not positive.
    """
    checks.positive("distance", distance)
    weights = controller.weights
    return (controller.steps - 1 + weights.terminal**2) * (weights.position * distance) ** 2


def excess(found: Promises, least: float) -> Float[Array, ""]:
    """By which share the realised cost exceeds the promised one, both summed over the calls: 0 for a promise kept.

    A sum that is below `least` a call counts as that: near zero a ratio says nothing.
    """
    broken = jnp.sum(found.realised) - jnp.sum(found.promised)
    return broken / jnp.maximum(jnp.sum(found.promised), least * len(found.promised))
