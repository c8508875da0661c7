"""Laws of the controller on single calls."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.control import Controller, Weights, add_body_rates, hover, sample
from hybrid_jax.rotation import from_axis_angle, normalise

# With equal arms hover needs equal speeds.
VEHICLE = dataclasses.replace(hj.IRIS, rotor_positions=((0.15, -0.2), (-0.15, 0.2), (0.15, 0.2), (-0.15, -0.2)))
LOWEST = 100.0  # rad/s
CONTROLLER = Controller(VEHICLE, min_speed=LOWEST)
BODY = hj.rigid_body(VEHICLE)


@eqx.filter_jit
def call(model, reference, x, plan, iterations):
    """The number of iterations is traced, so that all share one program."""
    return Controller(VEHICLE, min_speed=LOWEST, iterations=iterations)(model, reference, x, plan)


def command(x, reference, plan=None, model=BODY, iterations=1):
    return call(model, reference, x, CONTROLLER.begin() if plan is None else plan, jnp.asarray(iterations))


def hybrid(i):
    return hj.Hybrid(BODY, hj.residual_network(13, 4, jax.random.key(i), hidden=8))


@pytest.fixture(scope="module")
def still():
    reference = sample(hover((1.0, -2.0, 3.0)), CONTROLLER, 0.01)
    return reference[0], CONTROLLER.horizon(reference, 0)


@pytest.mark.parametrize("model", [lambda: BODY, lambda: hybrid(0)], ids=["physics", "hybrid"])
def test_q_and_minus_q_give_the_same_command(model, still):
    model = model()
    x, reference = still
    x = x.at[3:7].set(normalise(jnp.array([0.8, 0.3, -0.2, 0.5])))
    plan = opposite = None
    for _ in range(3):
        u, plan = command(x, reference, plan, model)
        again, opposite = command(x.at[3:7].multiply(-1), reference, opposite, model)
        np.testing.assert_array_equal(u, again)
        # The sign of the reference does not matter either; only rounding may differ.
        third, _ = command(x, reference.at[:, 3:7].multiply(-1), plan, model)
        np.testing.assert_allclose(third, command(x, reference, plan, model)[0], rtol=1e-5)


@pytest.mark.parametrize("cosine", [0.0, 1e-7, -1e-7])
def test_half_a_turn_of_yaw_is_corrected(still, cosine):
    x, reference = still
    x = x.at[3:7].set(jnp.array([cosine, 0.0, 0.0, 1.0]))
    u, _ = command(x, reference, iterations=6)
    torque = np.sum(np.array(VEHICLE.spin) * np.asarray(u) ** 2)
    # More than half of the largest yaw torque at hover thrust, in either direction.
    assert abs(torque) > 0.5 * 4 * VEHICLE.hover_speed**2


def test_speeds_reach_the_limits_and_stay_within(still):
    x, reference = still
    plan, found = None, []
    for away in (30.0, 3000.0, -30.0, -3000.0):
        _, plan = command(x.at[:3].add(away), reference, plan, iterations=4)
        found.append(CONTROLLER.speeds(plan))
    lowest, highest = np.min(found), np.max(found)
    assert LOWEST <= lowest < LOWEST + 10.0
    assert VEHICLE.max_rotor_speed - 10.0 < highest <= VEHICLE.max_rotor_speed


def test_more_iterations_never_raise_the_cost(still):
    x, reference = still
    turned = x.at[3:7].set(from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.array(2.5)))
    for start in (add_body_rates(x, (5.0, -6.0, 4.0)), turned, x.at[:3].add(3.0)):
        costs = np.array([command(start, reference, iterations=n)[1].cost for n in range(1, 13)])
        assert (np.diff(costs) <= 0).all()
        assert costs[-1] < 0.95 * costs[0]


def test_quaternion_length_is_ignored_if_traced_and_refused_if_concrete(still):
    x, reference = still
    x = x.at[3:7].set(normalise(jnp.array([0.8, 0.3, -0.2, 0.5])))
    for factor in (0.5, 1.1):
        long = x.at[3:7].multiply(factor)
        np.testing.assert_allclose(command(long, reference)[0], command(x, reference)[0], rtol=1e-4)
    for factor in (0.0, 1.1):
        with pytest.raises(ValueError, match=r"x\[3:7\] must be a unit quaternion"):
            CONTROLLER(BODY, reference, x.at[3:7].multiply(factor), CONTROLLER.begin())
    with pytest.raises(ValueError, match=r"reference\[2, 3:7\] must be a unit quaternion"):
        CONTROLLER(BODY, reference.at[2, 3:7].multiply(2.0), x, CONTROLLER.begin())


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"steps": 1}, "steps"),
        ({"interval": 0.055}, "interval must be a multiple"),
        ({"interval": 0.005}, "interval must be a multiple"),
        ({"min_speed": 700.0}, "hover speed"),
        ({"weights": {"position": 1.0}}, r"weights must be a Weights, got \{'position': 1.0\}"),
    ],
)
def test_invalid_hyper_parameters_are_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        Controller(**{"vehicle": hj.IRIS, **wrong})


def test_invalid_weights_and_shapes_are_refused(still):
    x, reference = still
    refusal(lambda: Weights(yaw=0.0), "yaw")
    refusal(lambda: CONTROLLER(BODY, reference[:-1], x, CONTROLLER.begin()), "reference")
    refusal(lambda: CONTROLLER(BODY, reference, x.at[0].set(jnp.nan), CONTROLLER.begin()), "finite")
    refusal(lambda: CONTROLLER(None, reference, x, CONTROLLER.begin()), "model must be a vector field, got None")
    with pytest.raises(ValueError, match=r"plan must have variables of shape \(20, 4\), got \(10, 4\)"):
        CONTROLLER(BODY, reference, x, Controller(VEHICLE, steps=10).begin())
