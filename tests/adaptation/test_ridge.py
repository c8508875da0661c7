"""Laws of adaptation in closed form: what is linear is recovered, a strong penalty changes nothing, flights improve."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybrid_jax import IRIS, AbstractVectorField, Hybrid, Trajectories, residual_network, rollout_batch
from hybrid_jax.adaptation.ridge import PENALTIES, fit_ridge, last_layer, linear_residual, mean_and_scale, ridge
from hybrid_jax.dynamics.rigid_body import perturbed
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.networks.mlp import InputScaling, LinearResidual
from hybrid_jax.sweep.lanes import lane, stack
from hybrid_jax.vehicle import QUATERNION, VELOCITY

HOVER = InputScaling(IRIS.hover_speed, IRIS.hover_speed / 10)
# Compiled once for all tests: fields and windows here have few shapes, and a penalty is an array.
_rolled, _fit_ridge, _mse = map(eqx.filter_jit, (rollout_batch, fit_ridge, rollout_mse))
_last_layer, _linear_residual = map(eqx.filter_jit, (last_layer, linear_residual))


def source(seed=0):
    key = jax.random.key(seed)
    return Hybrid(perturbed(IRIS, key), residual_network(13, 4, key, hidden=6, scaling=HOVER))


def flown(truth, count=100, seed=0, dt=0.01, steps=3):
    rng = np.random.default_rng(seed)
    x0 = rng.normal(size=(count, 13))
    x0[:, QUATERNION] += [3.0, 0.0, 0.0, 0.0]  # not half a turn, where a network reads the other quaternion
    x0[:, QUATERNION] *= rng.choice([-1, 1], (count, 1)) / np.linalg.norm(x0[:, QUATERNION], axis=1, keepdims=True)
    x0, u = jnp.asarray(x0, float), jnp.asarray(IRIS.hover_speed + 40 * rng.normal(size=(count, steps, 4)), float)
    return Trajectories(x0, u, _rolled(truth, x0, u, jnp.asarray(dt)), dt)


def missing(windows):
    """The same windows without 26 of 3900 numbers, so that 44 of 300 intervals do not count."""
    flat = windows.x.ravel()
    return eqx.tree_at(lambda w: w.x, windows, flat.at[::150].set(jnp.nan).reshape(windows.x.shape))


def with_linear(field):
    """The field and a linear residual that touches every derivative."""
    rng = np.random.default_rng(0)
    weight = 0.3 * rng.normal(size=(13, 17))
    weight[:, 13:] /= 50  # rotor speeds vary by 40 rad/s, all else by 1
    bias = rng.normal(size=13) - weight[:, 13:].sum(1) * IRIS.hover_speed
    return Hybrid(field, LinearResidual(jnp.asarray(weight), jnp.asarray(bias)))


def with_other_output(field):
    layer = (jax.random.normal(jax.random.key(8), (13, 6)), jax.random.normal(jax.random.key(9), (13,)))

    def where(field):
        network = field.residual if isinstance(field, Hybrid) else field
        return network.weight_out, network.bias_out

    return eqx.tree_at(where, field, layer)


@eqx.filter_jit
def derivatives(field, windows):
    return jax.vmap(field)(windows.x0, windows.u[:, 0])


@pytest.mark.parametrize(
    ("method", "start", "change"),
    [
        (_linear_residual, source, with_linear), (_last_layer, source, with_other_output),
        (_last_layer, lambda: source().residual, with_other_output),
    ],
    ids=["linear", "output layer", "output layer without physics"],
)  # fmt: skip
def test_a_correction_of_the_method_s_own_form_is_recovered(method, start, change):
    with jax.enable_x64(True):
        field, truth = start(), change(start())
        windows, others = missing(flown(truth)), flown(truth, seed=1)
        found = method(field, windows, jnp.asarray(1e-8))
        if isinstance(field, Hybrid):
            assert eqx.tree_equal(found.physics, field if method is _linear_residual else field.physics)
        wanted = derivatives(truth, others)
        before = jnp.abs(derivatives(field, others) - wanted).max()
        # The defects are exact to second order in dt = 0.01 s, on motions of a few rad/s.
        assert jnp.abs(derivatives(found, others) - wanted).max() < 3e-3 * before

        strong = method(field, windows, jnp.asarray(1e14))
        # At most Σ e z over the penalty: 300 intervals of 100 × 10, so 3e-9 for a weight, seen through 17 inputs.
        np.testing.assert_allclose(derivatives(strong, others), derivatives(field, others), rtol=0, atol=1e-6)


class Gusty(AbstractVectorField):
    """What neither method can represent: quadratic drag and a wind."""

    def __call__(self, x, u):
        v = x[VELOCITY]
        return jnp.zeros(13).at[VELOCITY].set(jnp.array([0.0, -2.0, 0.0]) - 0.2 * jnp.linalg.norm(v) * v)


@cache
def gusty(seed):
    return flown(Hybrid(source(), Gusty()), seed=seed)


@pytest.mark.parametrize(("method", "left"), [(last_layer, 0.8), (linear_residual, 0.1)])
def test_flights_not_seen_are_predicted_better(method, left):
    result = _fit_ridge(method, source(), gusty(0), gusty(1))
    assert _mse(result.field, gusty(2)) < left * _mse(source(), gusty(2))
    assert PENALTIES[-1] <= result.penalty < PENALTIES[0]
    np.testing.assert_allclose(result.mse, _mse(result.field, gusty(1)), rtol=1e-3)  # float32, sums in another order


def test_a_mapped_run_is_the_run_alone():
    fields, trains, held_out = [source(seed) for seed in range(3)], [gusty(seed) for seed in (0, 2, 3)], gusty(1)

    def one(field, train):
        return fit_ridge(last_layer, field, train, held_out)

    lanes = jax.device_get(eqx.filter_jit(eqx.filter_vmap(one))(stack(fields), stack(trains)))
    for i, (field, train) in enumerate(zip(fields, trains, strict=True)):
        here, alone = lane(lanes, i), _fit_ridge(last_layer, field, train, held_out)
        # Float32 defects carry 1e-7 / dt, and neighbours in the grid may predict equally well.
        np.testing.assert_allclose(here.mse, alone.mse, rtol=1e-3)
        np.testing.assert_allclose(derivatives(here.field, train), derivatives(alone.field, train), rtol=0, atol=1e-2)
    assert len({float(mse) for mse in lanes.mse}) == 3


@pytest.mark.parametrize("good", [1.0, 10.0])
def test_a_field_that_diverges_is_not_chosen(good):
    def update(field, windows, penalty, solver):
        return eqx.tree_at(lambda f: f.residual.bias_out, field, jnp.where(penalty == good, jnp.zeros(13), jnp.nan))

    found = _fit_ridge(update, source(), gusty(0), gusty(0), (10.0, 1.0))
    assert found.penalty == good
    assert jnp.isfinite(found.mse)


@pytest.mark.parametrize("penalty", [1e3, 1.0, 1e-4])
def test_ridge_in_single_precision_is_the_minimum_though_two_features_are_nearly_one(penalty):
    rng = np.random.default_rng(0)
    z = rng.normal(size=(300, 5))
    z[:, 4] = z[:, 3] + 1e-3 * z[:, 4]
    y = z @ rng.normal(size=(5, 2)) + 1 + 0.1 * rng.normal(size=(300, 2))
    design = np.column_stack([z, np.ones(300)])
    exact = np.linalg.solve(design.T @ design + penalty * np.eye(6), design.T @ y)
    weight, bias = ridge(jnp.asarray(z, np.float32), jnp.asarray(y, np.float32), penalty)
    off = np.column_stack([weight, bias]).T - exact
    # How far the penalised sum is above its minimum: squares of float32's round-off.
    assert ((design @ off) ** 2).sum() + penalty * (off**2).sum() < 1e-10 * (y**2).sum()


def test_a_channel_that_never_varied_is_no_feature():
    """A rotor that kept its speed while data were taken says nothing, however much it does later."""
    rng = np.random.default_rng(0)
    z = np.stack([rng.normal(3, 2, 1000), np.full(1000, 600.1), np.zeros(1000)], axis=1).astype(np.float32)
    mean, scale = mean_and_scale(z)
    scaled = (z - mean) / scale
    np.testing.assert_allclose(scaled[:, 0].std(), 1, rtol=1e-5)
    assert jnp.abs(scaled[:, 1:]).max() < 1e-2  # float32's round-off of the mean over 1e-3
