"""Laws of fields that are written for one sample: training through a user's module is training of what is inside."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import infer_batch, train_batch

from hybrid_jax import RK4, residual_network
from hybrid_jax.dynamics import base
from hybrid_jax.dynamics.composition import Frozen, Hybrid, check_batch_norm
from hybrid_jax.training.loss import rollout_minibatch

pytestmark = pytest.mark.usefixtures("double_precision")  # laws hold to round-off

STATES, INPUTS, WINDOWS, STEPS = 5, 2, 11, 3
CALLS = {
    "call": lambda network, x, u: network(x, u),
    "jit": lambda network, x, u: eqx.filter_jit(network)(x, u),
    "scan": lambda network, x, u: jax.lax.scan(lambda c, _: (network(x, u), None), x, length=1)[0],
    "vmap": lambda network, x, u: jax.vmap(network)(x[None], u[None])[0],
    "checkpoint": lambda network, x, u: eqx.filter_checkpoint(network)(x, u),
    "stop_gradient": lambda network, x, u: jax.lax.stop_gradient(network(x, u)),
    "grad": lambda network, x, u: jax.grad(lambda x: network(x, u).sum())(x),
}
HIDDEN_FROM_DERIVATIVES = ("stop_gradient", "grad")


class Gain(base.AbstractVectorField):
    inner: base.AbstractVectorField
    scale: float = eqx.field(static=True, default=1.0)
    how: str = eqx.field(static=True, default="call")

    def __call__(self, x, u):
        return self.scale * CALLS[self.how](self.inner, x, u)


class Sum(eqx.Module):
    parts: list

    def __call__(self, x, u):
        return sum(part(x, u) for part in self.parts)


def network(seed=0):
    return residual_network(STATES, INPUTS, jax.random.key(seed), hidden=7)


def batch():
    rng = np.random.default_rng(0)
    x = jnp.asarray(3 + 2 * rng.normal(size=(STATES, WINDOWS)))
    return x, jnp.asarray(rng.normal(size=(STEPS, INPUTS, WINDOWS)))


@eqx.filter_jit
def trained(field):
    x, u = batch()

    def loss(field):
        return jnp.sum(jnp.square(rollout_minibatch(field, x, u, 0.1, RK4())))

    return *eqx.filter_value_and_grad(loss)(field), base.as_field(field).update_running_stats(x, u[0])


def assert_trained_alike(field, other):
    found, expected = (jax.tree.leaves(eqx.filter(trained(each), eqx.is_array)) for each in (field, other))
    for one, two in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-11, atol=1e-11 * np.abs(two).max())  # order of sums


@pytest.mark.parametrize("how", [how for how in CALLS if how not in HIDDEN_FROM_DERIVATIVES])
def test_a_wrapped_network_is_trained_as_the_bare_one(how):
    check_batch_norm(Gain(network(), how=how), *(part[..., :2] for part in (batch()[0], batch()[1][0])))
    assert_trained_alike(Gain(network(), how=how), network())


def test_nested_wrappers_are_trained_as_their_hybrid_and_a_frozen_network_stays_in_inference_mode():
    assert_trained_alike(Sum([Gain(Gain(network(1))), network(2)]), Hybrid(network(1), network(2)))
    (x, u), field = batch(), Gain(Frozen(network()))
    expected = base.as_field(network()).infer_batch(x, u[0])
    np.testing.assert_allclose(base.as_field(field).train_batch(x, u[0]), expected, rtol=1e-12)
    assert eqx.tree_equal(base.as_field(field).update_running_stats(x, u[0]), field)


@pytest.mark.parametrize("how", HIDDEN_FROM_DERIVATIVES)
def test_statistics_that_cannot_be_recorded_are_refused(how):
    x, u = batch()
    with pytest.raises(ValueError, match="field: Gain contains a BatchNorm whose minibatch statistics cannot be"):
        check_batch_norm(Gain(network(), how=how), x, u[0])
    check_batch_norm(Gain(Frozen(network()), how=how), x, u[0])


def test_a_function_is_a_field():
    def field(x, u):
        return -x + u[0]

    x, u = batch()
    for evaluate in (train_batch, infer_batch):
        np.testing.assert_allclose(evaluate(field, x, u[0]), field(x, u[0]), rtol=1e-12)
    value, slope = base.as_field(field).linearize(x[:, 0], u[0, :, 0], jnp.eye(STATES), jnp.zeros((INPUTS, STATES)))
    np.testing.assert_allclose(value, field(x[:, 0], u[0, :, 0]), rtol=1e-12)
    np.testing.assert_array_equal(slope, -np.eye(STATES))
    assert base.as_field(field).update_running_stats(x, u[0]) is base.as_field(field).fuse_for_inference() is field
