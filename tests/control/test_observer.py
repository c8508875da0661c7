"""Laws of the disturbance observer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from hybrid_jax.control import Observer, advance
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.networks.mlp import InputScaling

DT = 0.01
TRUE = jnp.array([0.0, -4 / 1.5, 0.5, 0.3, -0.2, 0.1])
BODY = hj.rigid_body(hj.IRIS)
START = jnp.zeros(13).at[2].set(2.0).at[3].set(1.0)


def watch(field, plant, bandwidth, periods=100, sign=1.0):
    """Estimates over a flight of the plant at random speeds; the observer sees quaternions of this sign."""
    speeds = hj.IRIS.hover_speed + 20 * jax.random.normal(jax.random.key(0), (periods, 4))

    def tick(carry, u):
        x, state = carry
        x = advance(plant, x, u, DT)
        return (x, observer.update(state, x.at[3:7].multiply(sign), u)), state.disturbance

    observer = Observer(field, bandwidth, DT)
    start = START, observer.begin(START.at[3:7].multiply(sign))
    return np.asarray(jax.lax.scan(tick, start, speeds)[1])


@pytest.fixture(scope="module")
def fields():
    speeds = InputScaling(hj.IRIS.hover_speed, hj.IRIS.hover_speed / 10)
    network = hj.residual_network(13, 4, jax.random.key(0), hidden=8, scaling=speeds)
    return {"physics": BODY, "hybrid": hj.Hybrid(BODY, network), "network": network}


@pytest.mark.parametrize("name", ["physics", "hybrid", "network"])
def test_estimate_converges_at_the_bandwidth(fields, name):
    found = watch(fields[name], hj.Hybrid(fields[name], ConstantDisturbance(TRUE)), 5.0)
    share = -np.expm1(-5.0 * DT * np.arange(100))[:, None]
    # Rounding of v and ω over DT: 1e-6 / 0.01, more where a network's speeds are large.
    np.testing.assert_allclose(found, share * TRUE, rtol=0, atol=2e-2)


def test_zero_bandwidth_estimates_zero(fields):
    np.testing.assert_array_equal(watch(BODY, hj.Hybrid(BODY, ConstantDisturbance(TRUE)), 0.0), 0.0)


def test_exact_model_has_no_disturbance():
    np.testing.assert_allclose(watch(BODY, BODY, 5.0), 0.0, atol=1e-3)


def test_quaternion_sign_does_not_matter(fields):
    hybrid = fields["hybrid"]
    plant = hj.Hybrid(hybrid, ConstantDisturbance(TRUE))
    np.testing.assert_array_equal(watch(hybrid, plant, 5.0), watch(hybrid, plant, 5.0, sign=-1.0))
