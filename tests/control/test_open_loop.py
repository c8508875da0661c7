"""What a plan promises and what it costs: laws of their comparison."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from hybrid_jax.control import Controller, advance, fly, hover, actual_cost, sample
from hybrid_jax.control.cost import plan_cost
from hybrid_jax.control.open_loop import OpenLoopCosts, cost_of_offset, open_loop_costs, relative_cost_error
from hybrid_jax.dynamics.disturbance import disturbed

CONTROLLER = Controller(hj.IRIS)
BODY = hj.rigid_body(hj.IRIS)


def test_promises_are_those_of_the_calls_one_by_one():
    reference = sample(hover(), CONTROLLER, 0.3)

    def plant(x, u, t):
        return advance(disturbed(BODY, jnp.array([0.0, -1.0, 0.0, 0.0, 0.0, 0.0])), x, u, CONTROLLER.period)

    @jax.jit
    def both():
        flight = fly(plant, BODY, reference, reference[0], CONTROLLER)
        found = open_loop_costs(plant, flight, reference, CONTROLLER, [5, 20])
        return found, flight.plans.cost[20], actual_cost(plant, flight, reference, CONTROLLER, 20)

    found, promised, cost = both()
    np.testing.assert_allclose([found.predicted[1], found.actual[1]], [promised, cost], rtol=1e-5)
    assert found.actual[1] > 2 * found.predicted[1]


def test_the_least_promise_is_the_cost_of_being_so_far_off():
    reference = sample(hover(), CONTROLLER, 0.01)[:20]
    off = plan_cost(CONTROLLER.weights, reference, reference.at[:, 1].add(0.005), jnp.zeros((20, 4)))
    np.testing.assert_allclose(off, cost_of_offset(CONTROLLER), rtol=1e-4)
    with pytest.raises(ValueError, match="distance must be"):
        cost_of_offset(CONTROLLER, 0.0)


def test_excess_is_zero_for_a_promise_kept_and_does_not_explode_near_zero():
    kept = OpenLoopCosts(jnp.array([1.0, 3.0]), jnp.array([1.0, 3.0]))
    assert relative_cost_error(kept, 0.07) == 0
    assert relative_cost_error(OpenLoopCosts(kept.predicted, 1.1 * kept.actual), 0.07) == pytest.approx(0.1, rel=1e-5)
    assert relative_cost_error(OpenLoopCosts(jnp.array([0.0, 0.0]), jnp.array([0.007, 0.0])), 0.07) == pytest.approx(0.05, rel=1e-5)
