"""The benchmark's optimal control problems: IPOPT and fatrop solve them, and the controller's cost is theirs."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from hybrid_jax.networks import InputScaling

pytest.importorskip("casadi")
from benchmarks.control_problems import CONTROLLER, problems
from benchmarks.optimal_control import ITERATIONS, ours
from benchmarks.shooting import Shooting

NAMES = ("hop", "figure-8 window", "flip recovery", "low pass", "wind hover", "step")
SOLVERS = ("ipopt", "fatrop")
SCALING = InputScaling(hj.IRIS.hover_speed, hj.IRIS.hover_speed / 10)


def hybrid():
    """Its network is smooth, and adds tenths of a unit to ẋ, as a trained one does."""
    options = {"hidden": 4, "norm": "none", "activation": "softplus", "scaling": SCALING}
    network = hj.residual_network(13, 4, jax.random.key(0), **options)
    network = eqx.tree_at(lambda one: one.weight_out, network, 0.2 * network.weight_out)
    return hj.Hybrid(hj.rigid_body(hj.IRIS), network)


MODELS = {"physics": lambda: hj.rigid_body(hj.IRIS), "hybrid": hybrid}


@cache
def shooting(kind):
    return Shooting(MODELS[kind](), CONTROLLER)


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("name", NAMES)
def test_both_solvers_end_within_forty_iterations_at_the_same_feasible_plan(kind, name):
    problem = problems()[name]
    first, second = (shooting(kind).solve(solver, problem, ITERATIONS) for solver in SOLVERS)
    for found in (first, second):
        assert found.converged
        assert found.violation < 1e-5
        # Applied to the model, the inputs lead where the solver says.
        assert shooting(kind).cost(problem, found.share) == pytest.approx(found.cost, rel=1e-3)
    assert second.cost == pytest.approx(first.cost, rel=1e-4)


@pytest.mark.parametrize("name", ["low pass", "wind hover"])
def test_the_controller_minimises_the_same_cost_to_one_percent(name):
    problem, model = problems()[name], shooting("physics")
    plan = ours(MODELS["physics"](), problem, ITERATIONS)
    assert plan.cost == pytest.approx(model.cost(problem, plan.share), rel=1e-3)
    assert 0.999 < plan.cost / model.solve("ipopt", problem, ITERATIONS).cost < 1.01


def test_a_reference_is_that_of_the_controller():
    assert tuple(problems()) == NAMES
    for problem in problems().values():
        assert problem.reference.shape == (CONTROLLER.steps, 13)
        assert np.allclose(jnp.linalg.norm(problem.reference[:, 3:7], axis=1), 1, atol=1e-5)
