"""What commands did between the samples of a slow log is unknown, and counts as that."""

import numpy as np
import pytest
from test_identification import LAYOUT, TRUTH, holds, only, recorded, start

from hybrid_jax.flights.recording import Recording, Signal
from hybrid_jax.identification import slow_commands
from hybrid_jax.identification.fitting import identify
from hybrid_jax.records import integral

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
    line = integral(sampled, 0.01 * np.arange(len(values) - 10), "linear")
    middle = slice(4, None, 10)  # the mean from 0.04 to 0.05 s after a sample
    true = (values[4:-1:10] + values[5::10]) / 2
    line = np.diff(line, axis=0)[middle] / 0.01
    strayed = true[: len(line)] - line
    edges = STEP + 0.04 + 0.01 * np.arange(2)
    each = slow_commands.bridges(np.array([[[STEP, 2 * STEP]]]), edges, root)[0, :, 0]
    found = each.T @ each
    assert (np.diag(found) < np.diag(strayed.T @ strayed) / len(strayed)).all()
    np.testing.assert_allclose(found, strayed.T @ strayed / len(strayed), rtol=0.25)


def test_fast_commands_are_held_and_know_no_bridge():
    fast = Signal(0.01 * np.arange(50), np.random.default_rng(0).normal(size=(50, 4)), tuple("0123"), "fast")
    assert slow_commands.count(fast, 0.5) == 0
    assert not slow_commands.root([fast]).any()


def test_noise_is_told_from_what_bridges_do():
    rng, n, t = np.random.default_rng(1), 300, 20
    slopes = rng.normal(size=(n, t, 2, 3)) * np.array([[0.5], [2.0]])
    noise = np.array([0.1, 0.4])
    errors = np.einsum("ntku,nu->ntk", slopes, rng.normal(size=(n, 3))) + noise * rng.normal(size=(n, t, 2))
    r, b = errors.reshape(n, -1), slopes.reshape(n, -1, 3)
    found, whitening = slow_commands.whitened(r, b, np.ones((n, 2 * t), bool), np.tile([0, 1], t))
    np.testing.assert_allclose(found, noise, rtol=0.03)
    white = whitening @ (errors / noise).reshape(n, -1, 1)
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
