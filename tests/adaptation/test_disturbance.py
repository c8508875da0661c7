"""θ_p and a steady push are told apart by seconds of flight, and all that the network knows stays."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import hybrid_jax as hj
from hybrid_jax.adaptation.least_squares import fit_least_squares
from hybrid_jax.dynamics.base import infer_batch, train_batch
from hybrid_jax.dynamics.disturbance import disturbed, with_disturbance
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.networks.factory import make_residual

PUSH = jnp.array([0.3, 2.7, -0.5, 0.2, -0.1, 0.05])
RATIOS = {"Ix": 0.6, "Iy": -0.3, "k": 0.05}


def network():
    made = make_residual(jax.random.key(0), inputs="no_xy_yaw", outputs="accelerations", hidden=8, norm="none")
    return jax.tree.map(lambda leaf: 0.1 * leaf, made)


def body(**ratios):
    return hj.RigidBody({name: jnp.asarray(ratios.get(name, 0.0)) for name in RATIOS}, hj.IRIS)


def flights(field, count=20, steps=10):
    keys = jax.random.split(jax.random.key(1), 2)
    x0 = 0.5 * jax.random.normal(keys[0], (count, 13))
    x0 = x0.at[:, 3].add(2.0)
    x0 = x0.at[:, 3:7].divide(jnp.linalg.norm(x0[:, 3:7], axis=1, keepdims=True))
    u = hj.IRIS.hover_speed * jax.random.uniform(keys[1], (count, steps, 4), minval=0.8, maxval=1.2)
    return hj.Trajectories(x0, u, rollout_batch(field, x0, u, 0.01), dt=0.01)


def test_parameters_and_push_are_found_together_and_the_network_stays():
    truth = hj.Hybrid(disturbed(body(**RATIOS), PUSH), network())
    found = fit_least_squares(with_disturbance(hj.Hybrid(body(), network())), flights(truth))
    assert found.converged
    for name, ratio in RATIOS.items():
        np.testing.assert_allclose(found.field.physics.physics.log_ratios[name], ratio, atol=2e-3)
    np.testing.assert_allclose(found.field.physics.residual.value, PUSH, atol=5e-3)
    assert eqx.tree_equal(found.field.residual, network())


def test_without_one_the_parameters_pay_for_the_push():
    """What it is for: were the push within reach of θ_p, nobody would need it."""
    truth = hj.Hybrid(disturbed(body(**RATIOS), PUSH), network())
    windows = flights(truth)
    alone = fit_least_squares(hj.Hybrid(body(), network()), windows)
    assert alone.mse > 100 * fit_least_squares(with_disturbance(hj.Hybrid(body(), network())), windows).mse


def test_it_adds_to_the_accelerations_of_one_state_and_of_many():
    x, u = flights(body(), count=5).x[:, 0], jnp.full((5, 4), 600.0)
    field = disturbed(body(), PUSH)
    one = jax.vmap(body())(x, u).at[:, 7:].add(PUSH)
    np.testing.assert_allclose(jax.vmap(field)(x, u), one, rtol=1e-6)
    for many in (train_batch, infer_batch):
        np.testing.assert_allclose(many(field, x.T, u.T).T, one, rtol=1e-5, atol=1e-5)


def test_a_model_with_one_is_kept(tmp_path):
    field = hj.Hybrid(disturbed(body(), PUSH), network())
    hj.save(tmp_path / "model.npz", field)
    assert eqx.tree_equal(hj.load(tmp_path / "model.npz").field, field)
