"""Reaction-diffusion equations: the generator, the jobs, the smallest preset, and what the command refuses."""

import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from experiments.reaction_diffusion.models import pieces
from experiments.reaction_diffusion.systems import COARSE, DT, FINE, fitzhugh_nagumo, plane, reacting, trajectories


def smooth(points):
    """A smooth start on [−1, 1]², which every grid resolves."""
    place = np.arange(points) / points * 2 * np.pi
    wave = np.sin(place)[:, None] * np.cos(place)
    return np.stack([0.5 + 0.3 * wave, 0.2 - 0.3 * wave.T]).reshape(1, -1).astype(np.float32)


def test_the_generator_converges_with_the_grid_and_the_step():
    ends = {}
    for points in (16, 32, 64):
        field = fitzhugh_nagumo(plane(points), a=0.02, b=0.05)
        end = trajectories(field, smooth(points), DT, 5, hj.RK4(substeps=50)).x[0, -1]
        ends[points] = end.reshape(2, points, points)[:, :: points // 16, :: points // 16]
    coarse, fine = (np.abs(ends[n] - ends[2 * n]).max() for n in (16, 32))
    assert 3 < coarse / fine < 5  # second order
    field, start = fitzhugh_nagumo(plane(32)), np.random.default_rng(0).random((1, 2048)).astype(np.float32)
    exact, own, models = (trajectories(field, start, DT, 3, s).x for s in (hj.RK4(substeps=40), FINE, COARSE))
    assert np.abs(own - exact).max() < 1e-6
    assert np.mean(np.square(models - exact)) < 1e-8


def test_the_derivative_is_the_equation():
    grid = plane(8)
    x = np.random.default_rng(0).random(grid.size).astype(np.float32)
    u, v = x.reshape(2, 8, 8)
    around = [sum(np.roll(w, s, axis) for axis in (0, 1) for s in (1, -1)) - 4 * w for w in (u, v)]
    bend = [part / 0.25**2 for part in around]
    expected = [1e-3 * bend[0] + u - u**3 - v - 5e-3 - 0.5 * u * v, 5e-3 * bend[1] + u - v]
    found = fitzhugh_nagumo(grid, coupling=-0.5)(jnp.asarray(x), jnp.zeros(0))
    np.testing.assert_allclose(found, np.ravel(expected), atol=1e-5)


def test_training_and_test_data_are_disjoint_and_pieces_touch():
    field = fitzhugh_nagumo(plane(8))
    one, other = (reacting(field, 2, (seed, 0)) for seed in (10, 11))
    assert not np.array_equal(one.x0, other.x0)
    windows = pieces(one, 3, 3)
    assert len(windows) == 16
    np.testing.assert_array_equal(windows.x[0, -1], windows.x0[1])  # in the order of time, one trajectory after another
    np.testing.assert_array_equal(windows.x0[8], one.x0[1])
    noisy = reacting(field, 2, (10, 0), noise=0.01)
    assert np.std(noisy.x - one.x) == pytest.approx(0.01, rel=0.1)
