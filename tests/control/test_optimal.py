"""The controller's plans cost as little as the optimum that IPOPT finds for the same discretised problem."""

from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from hybrid_jax.control import Controller, add_body_rates, advance, figure_eight, hover, sample
from hybrid_jax.rotation import from_axis_angle

pytest.importorskip("casadi")
from optimal import best_cost

CONTROLLER = Controller(hj.IRIS)
BODY = hj.rigid_body(hj.IRIS)
PATHS = {"still": hover((0.0, 0.0, 2.0)), "eight": figure_eight(6.0)}


@cache
def reference_of(name):
    return sample(PATHS[name], CONTROLLER, 0.3)


@eqx.filter_jit
def plan_of(x, reference, plan, iterations):
    """The number of iterations is traced, so that all share one program."""
    return Controller(hj.IRIS, iterations=iterations)(BODY, reference, x, plan)


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


def check(plan, reference, x, saturated):
    best, speeds = best_cost(CONTROLLER, np.asarray(reference, float), np.asarray(x, float))
    # Not below it either, or the problems would differ. Tanh stays 0.25 % of the range off the limits.
    assert 0.999 < float(plan.cost) / best < 1.01
    at_limit = (speeds < 0.01 * hj.IRIS.max_rotor_speed) | (speeds > 0.99 * hj.IRIS.max_rotor_speed)
    assert at_limit.mean() >= saturated


@pytest.mark.parametrize("name", STARTS)
def test_cold_start_converges(name):
    path, moved, iterations, saturated = STARTS[name]
    reference = CONTROLLER.horizon(reference_of(path), 0)
    x = moved(reference_of(path)[0])
    _, plan = plan_of(x, reference, CONTROLLER.begin(), jnp.asarray(iterations))
    check(plan, reference, x, saturated)


def test_one_iteration_per_call_is_enough():
    still = reference_of("still")[:20]
    x, plan = add_body_rates(still[0]), CONTROLLER.begin()
    for _ in range(20):
        u, plan = plan_of(x, still, plan, jnp.asarray(1))
        x = advance(BODY, x, u, CONTROLLER.period)
    _, plan = plan_of(x, still, plan, jnp.asarray(1))
    check(plan, still, x, 0.0)
