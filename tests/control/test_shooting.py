"""The benchmark's optimal control problems: IPOPT and fatrop solve them, and the controller's cost is theirs."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from hybrid_jax.control import figure_eight, hover, sample
from hybrid_jax.networks import InputScaling
from hybrid_jax.rotation import from_axis_angle

pytest.importorskip("casadi")
from benchmarks.control_problems import CONTROLLER, Problem, problems
from benchmarks.optimal_control import ITERATIONS, ours
from benchmarks.shooting import Shooting

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
@pytest.mark.parametrize("name", problems())
def test_both_solvers_end_within_forty_iterations_at_the_same_feasible_plan(kind, name):
    problem = problems()[name]
    first, second = (shooting(kind).solve(solver, problem, ITERATIONS) for solver in SOLVERS)
    for found in (first, second):
        assert found.converged
        assert found.violation < 1e-5
        # Applied to the model, the inputs lead where the solver says.
        assert shooting(kind).cost(problem, found.share) == pytest.approx(found.cost, rel=1e-3)
    assert second.cost == pytest.approx(first.cost, rel=1e-4)


@cache
def states_of(name):
    return sample(hover((0.0, 0.0, 2.0)) if name == "still" else figure_eight(6.0), CONTROLLER, 0.3)


def turned(axis, angle):
    return from_axis_angle(jnp.eye(3)[axis], jnp.array(angle))


# Reference, initial state from its first one, iterations, and the least share of rotor speeds at a limit.
STARTS = {
    "near": ("still", lambda x: x.at[0].add(0.1).at[7].set(0.3), 4, 0.0),
    "leaning": ("still", lambda x: x.at[3:7].set(turned(0, 0.8)), 32, 0.0),
    "metres away": ("still", lambda x: x.at[:3].add(jnp.array([3.0, -2.0, 1.0])), 16, 0.4),
    "turned about": ("still", lambda x: x.at[3:7].set(turned(2, 2.5)), 8, 0.1),
    "off the figure": ("eight", lambda x: x.at[:3].add(0.3), 32, 0.01),
}


def check(cost, x, reference, saturated=0.0):
    """The cost is that of IPOPT, not below it either, or the problems would differ."""
    problem = Problem(np.asarray(x, float), np.asarray(reference, float), np.zeros(6))
    best = shooting("physics").solve("ipopt", problem, 300)
    assert best.converged
    assert 0.999 < cost / best.cost < 1.01
    assert (np.abs(best.share) > 0.98).mean() >= saturated


@pytest.mark.parametrize("name", STARTS)
def test_the_controller_converges_from_a_cold_start(name):
    path, moved, iterations, saturated = STARTS[name]
    x, reference = moved(states_of(path)[0]), CONTROLLER.horizon(states_of(path), 0)
    problem = Problem(np.asarray(x), np.asarray(reference), np.zeros(6, np.float32))
    check(ours(MODELS["physics"](), problem, iterations).cost, x, reference, saturated)
