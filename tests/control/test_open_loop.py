"""Laws of predicted and actual open-loop costs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from hybrid_jax.control import Controller, advance, fly, hover, sample
from hybrid_jax.control.cost import plan_cost
from hybrid_jax.control.open_loop import OpenLoopCosts, open_loop_costs, relative_cost_error
from hybrid_jax.dynamics.disturbance import disturbed

CONTROLLER = Controller(hj.IRIS)
BODY = hj.rigid_body(hj.IRIS)


def test_costs_of_several_calls_equal_those_of_single_calls():
    reference = sample(hover(), CONTROLLER, 0.3)

    def plant(x, u, t):
        return advance(disturbed(BODY, jnp.array([0.0, -1.0, 0.0, 0.0, 0.0, 0.0])), x, u, CONTROLLER.period)

    @jax.jit
    def both():
        flight = fly(plant, BODY, reference, reference[0], CONTROLLER)
        return [open_loop_costs(plant, flight, reference, CONTROLLER, calls) for calls in ([5, 20], [20])]

    found, single = both()
    np.testing.assert_allclose(
        [found.predicted[1], found.actual[1]], [single.predicted[0], single.actual[0]], rtol=1e-5
    )
    assert found.actual[1] > 2 * found.predicted[1]


def test_relative_cost_error_is_bounded_near_zero():
    costs = OpenLoopCosts(jnp.array([1.0, 3.0]), jnp.array([1.0, 3.0]))
    assert relative_cost_error(costs, CONTROLLER) == 0
    higher = OpenLoopCosts(costs.predicted, 1.1 * costs.actual)
    assert relative_cost_error(higher, CONTROLLER) == pytest.approx(0.1, rel=1e-5)
    # The denominator is at least the cost of an offset of 5 mm.
    reference = sample(hover(), CONTROLLER, 0.01)[:20]
    floor = plan_cost(CONTROLLER.weights, reference, reference.at[:, 1].add(0.005), jnp.zeros((20, 4)))
    small = OpenLoopCosts(jnp.array([0.0, 0.0]), jnp.array([0.1 * floor, 0.0]))
    assert relative_cost_error(small, CONTROLLER) == pytest.approx(0.05, rel=1e-4)
    with pytest.raises(ValueError, match="distance must be"):
        relative_cost_error(costs, CONTROLLER, 0.0)
