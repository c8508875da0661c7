"""Laws of the loss and of each regulariser, in double precision."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import pendulum

from hybrid_jax import RK4, AbstractVectorField, Hybrid, Settings, Trajectories, residual_network, rollout_batch
from hybrid_jax.networks import zero_output
from hybrid_jax.training import TrajectoryLoss
from hybrid_jax.training.loss import REGULARISERS, along, cosine, rollout_minibatch

pytestmark = pytest.mark.usefixtures("double_precision")
DT, WINDOWS, STEPS = 0.05, 6, 4
TURN, OTHER = np.array([[0.3, 1.2], [-0.7, 0.4]]), np.array([[0.5, -0.1], [0.2, 0.9]])


class Affine(AbstractVectorField):
    """ẋ = A x + b: parts of a hybrid whose angle is known."""

    matrix: jax.Array
    offset: jax.Array

    def __call__(self, x, u):
        return self.matrix @ x + self.offset


def affine(matrix, offset=(0.0, 0.0)):
    return Affine(jnp.asarray(matrix, float), jnp.asarray(offset, float))


def windows():
    rng = np.random.default_rng(0)
    x0, u = jnp.asarray(rng.normal(size=(WINDOWS, 2))), jnp.asarray(rng.normal(size=(WINDOWS, STEPS, 1)))
    return Trajectories(x0, u, rollout_batch(pendulum(damping=0.8), x0, u, DT), DT)


@pytest.fixture(scope="module")
def batch(double_precision):
    return TrajectoryLoss().batch(windows(), Settings())


@eqx.filter_jit
def regulariser(name, field, batch):
    return REGULARISERS[name](field, batch, rollout_minibatch(field, batch.x0, batch.u, batch.dt, RK4()))


def network(seed=0):
    return residual_network(2, 1, jax.random.key(seed), hidden=5)


def test_trajectory_correlation_is_the_paper_s_formula_and_shows_small_differences_in_single_precision(batch):
    field = Hybrid(pendulum(0.7), network())
    cut = windows()
    physics = np.asarray(rollout_batch(field.physics, cut.x0, cut.u, DT)).reshape(WINDOWS, -1)
    predicted = rollout_minibatch(field, batch.x0, batch.u, DT, RK4())
    whole = np.asarray(jnp.moveaxis(predicted, -1, 0)).reshape(WINDOWS, -1)
    product = (physics * whole).sum(1) / np.linalg.norm(physics, axis=1) / np.linalg.norm(whole, axis=1)
    found = regulariser("trajectory_correlation", field, batch)
    # The 1e-12 under the square root, against squared norms of about 1.
    np.testing.assert_allclose(found, np.mean(1 - product), rtol=0, atol=1e-11)
    # 1 − ⟨a, b⟩ would round to 0 or to 6e-8 here.
    with jax.enable_x64(False):
        single = jax.tree.map(lambda leaf: jnp.asarray(leaf, np.float32), batch)
        push = affine(np.zeros((2, 2)), (0.0, 1e-3))
        value = regulariser("trajectory_correlation", Hybrid(pendulum(), push), single)
    exact = regulariser("trajectory_correlation", Hybrid(pendulum(), push), batch)
    assert exact < 1e-7
    np.testing.assert_allclose(value, exact, rtol=0.05)  # the differences of 1e-4 carry an error of 1e-7


def test_cosine_is_one_for_parallel_parts_and_zero_for_orthogonal_ones_and_the_residual_norm_a_mean_square(batch):
    def value(other):
        return regulariser("cosine", Hybrid(affine(TURN), affine(other)), batch)

    # The 1e-12 of the unit vectors, against squared norms of at least 1e-4.
    np.testing.assert_allclose([value(2.0 * TURN), value(-0.5 * TURN)], 1, rtol=0, atol=1e-7)
    assert abs(value(np.array([[0.0, -1.0], [1.0, 0.0]]) @ TURN)) < 1e-20  # a quarter turn
    field = Hybrid(pendulum(), affine(np.zeros((2, 2)), (3.0, 4.0)))
    np.testing.assert_allclose(regulariser("residual_norm", field, batch), 25, rtol=1e-12)


def test_inner_product_is_the_squared_product_of_the_parts_and_pearson_their_correlation(batch):
    field = Hybrid(affine(TURN), affine(OTHER, (0.3, -0.2)))
    predicted = rollout_minibatch(field, batch.x0, batch.u, DT, RK4())
    x = np.concatenate([batch.x0[None], np.asarray(predicted)[:-1]])
    products = np.einsum("tib,tib->tb", np.einsum("ij,tjb->tib", TURN, x),
                         np.einsum("ij,tjb->tib", OTHER, x) + np.array([0.3, -0.2])[:, None])  # fmt: skip
    found = regulariser("inner_product", field, batch)
    np.testing.assert_allclose(found, np.mean(products**2), rtol=1e-12)
    assert abs(regulariser("inner_product", Hybrid(affine(TURN), affine([[0.7, -0.4], [0.3, 1.2]])), batch)) < 1e-25
    other = affine(OTHER)
    predicted = rollout_minibatch(Hybrid(affine(TURN), other), batch.x0, batch.u, DT, RK4())

    def value(residual):
        return REGULARISERS["pearson"](Hybrid(affine(TURN), residual), batch, predicted)

    x, _ = along(batch.x0, predicted, batch.u)
    expected = [np.corrcoef(a, b)[0, 1] ** 2 for a, b in zip(TURN @ x, other.matrix @ x, strict=True)]
    np.testing.assert_allclose(value(other), np.mean(expected), rtol=1e-9)  # the 1e-12 under the roots
    np.testing.assert_allclose(value(affine(-7 * other.matrix, (5.0, -3.0))), value(other), rtol=1e-9)
    np.testing.assert_allclose(value(affine(3 * TURN, (1.0, 1.0))), 1, rtol=1e-9)


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_gradients_are_finite_where_the_residual_is_zero(precision, batch):
    def values(field, batch):
        predicted = rollout_minibatch(field, batch.x0, batch.u, batch.dt, RK4())
        return {name: rule(field, batch, predicted) for name, rule in REGULARISERS.items()}

    with jax.enable_x64(precision == np.float64):
        given = Hybrid(pendulum(), zero_output(network())), batch
        given = jax.tree.map(lambda leaf: jnp.asarray(leaf, precision), given)
        found, slopes = eqx.filter_jit(lambda *given: (values(*given), jax.jacrev(values)(*given)))(*given)
    for name, slope in slopes.items():
        assert abs(found[name]) < 1e-10, name
        assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(slope)), name


def test_the_loss_is_the_error_plus_the_weighted_regulariser_and_settings_that_are_none_are_refused(batch):
    def loss(field, batch, rule, weight):
        return TrajectoryLoss().loss(field, batch, Settings(regulariser=rule), weight)[0]

    field = Hybrid(pendulum(0.7), network())
    predicted = rollout_minibatch(field, batch.x0, batch.u, DT, RK4())
    error = np.square(np.asarray(predicted - batch.x)).sum(1).mean()
    np.testing.assert_allclose(loss(field, batch, None, 1e3), error, rtol=1e-13)
    for rule in REGULARISERS.values():
        expected = error + 0.3 * rule(field, batch, predicted)
        np.testing.assert_allclose(loss(field, batch, rule, 0.3), expected, rtol=1e-13)
    for field in (pendulum(0.7), network()):  # without two parts there is none
        assert loss(field, batch, cosine, 1e3) == loss(field, batch, None, 0.0)
    wrong = {"regulariser": "cosine", "solver": "rk4", "objective": TrajectoryLoss, "batch_size": 10.0}
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=f"^{name} must be"):
            Settings(**{name: value})


def test_samples_begin_at_the_start_of_each_interval_also_without_inputs():
    x0, x = jnp.zeros((2, 3)), jnp.ones((4, 2, 3))
    starts, u = along(x0, x, jnp.zeros((4, 0, 3)))
    np.testing.assert_array_equal(starts, np.repeat([0, 1, 1, 1], 3)[None].repeat(2, axis=0))
    assert u.shape == (0, 12)
