"""What commands did between the samples of a slow log is unknown, and counts as that."""

import numpy as np
import pytest
from test_identification import LAYOUT, TRUTH, holds, only, recorded, start

from hybrid_jax.flights.recording import Recording, Signal
from hybrid_jax.identification import slow_commands
from hybrid_jax.identification.fitting import identify

STEP = 0.1
MIX = np.array([[1.0, 0.0], [0.8, 0.3]])


def walk(n=20_000, dt=0.01, seed=0):
    """A random walk of covariance M Mᵀ in a second, and its samples a tenth of a second apart."""
    steps = np.random.default_rng(seed).normal(size=(n, 2)) @ MIX.T * np.sqrt(dt)
    t, values = dt * np.arange(n), np.cumsum(steps, axis=0)
    return t, values, Signal(t[::10], values[::10], ("0", "1"), "walk")


def test_a_random_walk_is_a_line_and_a_bridge_between_its_samples():
    _, values, sampled = walk()
    root = slow_commands.root([sampled])
    np.testing.assert_allclose(root @ root.T, MIX @ MIX.T, rtol=0.05, atol=0.02)
    at, line = slow_commands.lines(sampled, 0.01)
    middle = slice(4, None, 10)  # the mean from 0.04 to 0.05 s after a sample
    true = (values[4:-1:10] + values[5::10]) / 2
    strayed = (true[: len(line[middle])] - line[middle][: len(true)])[:-1]  # from the line
    edges = 0.04 + 0.01 * np.arange(2)
    basis = np.eye(2 * slow_commands.MODES)
    each = np.array([slow_commands.means(one, np.array([[0.0, STEP]]), root, edges)[0] for one in basis])
    found = each.T @ each
    assert (np.diag(found) < np.diag(strayed.T @ strayed) / len(strayed)).all()
    np.testing.assert_allclose(found, strayed.T @ strayed / len(strayed), rtol=0.25)
    assert at[4] == pytest.approx(0.04)


def test_a_bridge_is_nothing_outside_its_interval_and_comes_later_by_a_delay():
    span, root, one = np.array([[1.0, 1.1]]), np.eye(1), np.array([0.7, -0.4])
    edges = np.linspace(0.8, 1.3, 6)
    found = np.asarray(slow_commands.means(one, span, root, edges))[:, 0]
    np.testing.assert_allclose(found[[0, 1, 3, 4]], 0, atol=1e-6)
    assert abs(found[2]) > 0.01
    late = np.asarray(slow_commands.means(one, span, root, edges, 0.1))[:, 0]
    np.testing.assert_allclose(late[1:], found[:-1], atol=1e-6)


def test_fast_commands_are_held_and_know_no_bridge():
    fast = Signal(0.01 * np.arange(50), np.random.default_rng(0).normal(size=(50, 4)), tuple("0123"), "fast")
    assert slow_commands.count(fast, 0.5) == 0
    assert slow_commands.lines(fast, 0.005)[1] is fast.values
    assert not slow_commands.root([fast]).any()


def test_noise_is_told_from_what_bridges_do():
    rng, n, t = np.random.default_rng(1), 300, 20
    slopes = {"rates": rng.normal(size=(n, t, 2, 3)) * np.array([[0.5], [2.0]])}
    noise = np.array([0.1, 0.4])
    strayed = np.einsum("ntku,nu->ntk", slopes["rates"], rng.normal(size=(n, 3)))
    errors = {"rates": strayed + noise * rng.normal(size=(n, t, 2))}
    scale, whitening = slow_commands.whitened(errors, slopes, {"rates": np.ones((n, t), bool)}, {"rates": np.ones(2)})
    np.testing.assert_allclose(scale["rates"], noise, rtol=0.03)
    white = whitening @ (errors["rates"] / noise).reshape(n, -1, 1)
    np.testing.assert_allclose((white**2).mean(), 1, rtol=0.05)


@pytest.mark.slow
def test_ten_commands_in_a_second_tell_the_inertia_and_the_intervals_hold():
    """Held between its samples, such a log gives inertias that are too large by a factor of two."""
    twin = only(recorded(hold=4, smooth=0.95), "rates", "specific_force")
    every = twin.signals["command"]
    slow = Signal(every.t[3::20], every.values[3::20], every.axes, "command")
    found = identify(start(), [Recording("slow", {**twin.signals, "command": slow})], LAYOUT)
    truth = {"Ix": 0.035, "Iy": 0.026, "k": TRUTH.thrust_coefficient, "time_constant": 0.07}
    assert all(holds(found.intervals, **truth).values())
    for name, value in truth.items():
        np.testing.assert_allclose(float(found.intervals[name].value), value, rtol=0.1, err_msg=name)
