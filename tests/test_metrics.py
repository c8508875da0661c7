"""Laws of the metrics."""

import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import DAMPING, pendulum, swings

from hybrid_jax import metrics
from hybrid_jax.integrate import SOLVERS, rollout_batch


def test_a_perfect_model_has_no_error():
    windows = swings(20)
    # Equal up to float32 round-off of states of about 10: (1e-6)² a number, and the order of vmap.
    assert metrics.rollout_mse(pendulum(damping=DAMPING), windows) < 1e-10
    assert metrics.rollout_mse(pendulum(damping=0.0), windows) > 1e-3


@pytest.mark.parametrize(("every", "chunk"), [(1, 250), (2, 7), (4, 250), (8, 20)])
def test_it_is_the_definition_at_every_so_many_intervals(every, chunk):
    windows, field = swings(20), pendulum(0.6)
    predicted = np.asarray(rollout_batch(field, windows.x0, windows.u, windows.dt), np.float64)
    squares = np.square(predicted - np.asarray(windows.x)).sum(-1)
    rows = [i for i in range(8) if (i + 1) % every == 0]
    found = metrics.rollout_mse(field, windows, every, chunk=chunk)
    np.testing.assert_allclose(found, squares[:, rows].mean(), rtol=1e-5)  # float32 sums of 160 numbers


def test_the_solver_is_the_one_asked_for():
    windows, field = swings(20), pendulum(damping=DAMPING)
    # The data are RK4's own; Heun differs by its error at a step of 0.05.
    assert metrics.rollout_mse(field, windows, solver=SOLVERS["heun"]) > 1e-6


def test_mse_by_hand():
    truth = jnp.zeros((2, 2, 3))
    predicted = jnp.array([[1.0, 2.0, 2.0], [0.0, 3.0, 4.0]])
    both = metrics.mse(jnp.stack([predicted, 2 * predicted]), truth)
    np.testing.assert_array_equal(both, [17, 68])  # squared norms, mean over time: not over the elements


def test_an_error_beyond_float_is_not_finite():
    lost = pendulum(damping=-1e6)
    assert not jnp.isfinite(metrics.rollout_mse(lost, swings(20)))
