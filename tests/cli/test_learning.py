"""Predictions with what was seen before, of recorded flights."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from recorded import LOGS

import hybrid_jax as hj
from hybrid_jax.cli.errors import errors_of
from hybrid_jax.cli.learning import STEPS, with_past, without_past
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.vehicle import IRIS

BODY = hj.rigid_body(IRIS)


def test_a_push_that_the_model_lacks_is_predicted_from_the_errors_before():
    lacking = hj.Hybrid(BODY, ConstantDisturbance(jnp.array([0, 0, -1.0, 0, 0, 0])))  # these flights have no such force
    model = with_past(lacking, LOGS[:6])
    assert eqx.tree_equal(without_past(model), lacking)
    before, after = (errors_of(field, LOGS[7], STEPS)[2:, -1, 1].mean() for field in (lacking, model))
    assert after < 0.3 * before


def test_weights_of_zero_have_the_errors_of_the_field_in_the_same_windows():
    model = with_past(BODY, LOGS[:3], most=3 * 60)
    model = eqx.tree_at(lambda each: each.weights, model, 0 * model.weights)
    np.testing.assert_allclose(errors_of(model, LOGS[4], STEPS), errors_of(BODY, LOGS[4], STEPS), atol=2e-5)
