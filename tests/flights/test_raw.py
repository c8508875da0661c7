"""Slow signals that a program drew as lines on a fast clock are read as the samples that they were."""

import numpy as np
import pytest

from hybrid_jax.flights.formats.raw import Samples, own_samples, record


def drawn(t, own, values):
    return np.stack([np.interp(t, own, column) for column in values.T], axis=1)


@pytest.mark.parametrize("beside", [0.0, 0.004])
def test_lines_become_the_samples_at_their_bends(beside):
    rng, t = np.random.default_rng(0), 0.01 * np.arange(501)
    own = np.append(0.1 * np.arange(50) + beside * (np.arange(50) % 3 == 1), 5.0)
    values = rng.normal(size=(51, 4))
    values[30:33] = values[29] + np.arange(1, 4)[:, None] * 0.5  # a line over three intervals
    found, rows = own_samples(t, drawn(t, own, values))
    assert len(found) == len(own)
    np.testing.assert_allclose(np.delete(found, [30, 31, 32]), np.delete(own, [30, 31, 32]), atol=1e-6)
    np.testing.assert_allclose(rows, drawn(found, own, values), atol=1e-5)


def test_a_line_over_a_gap_is_no_measurement():
    t, own = 0.01 * np.arange(501), np.delete(0.1 * np.arange(51), np.arange(20, 29))
    found, _ = own_samples(t, drawn(t, own, np.random.default_rng(3).normal(size=(42, 4))))
    np.testing.assert_allclose(found, own, atol=1e-6)


def test_noise_steps_and_rest_stay_as_they_are():
    rng, t = np.random.default_rng(1), 0.01 * np.arange(500)
    noise = rng.normal(size=(500, 3))
    smooth = np.sin(3 * t)[:, None]
    for values in (noise, smooth, np.round(smooth, 2), 0 * noise, np.where(t[:, None] > 2, noise, 0.0), noise * np.nan):
        assert own_samples(t, values)[1] is values


@pytest.mark.parametrize("rows", [[2], [3], [3, 3, 4], [10]], ids=str)
def test_values_that_were_repeated_are_samples_once(rows):
    """Forward-filled, as by pandas; while it rests, a value counts as often as when it changes."""
    counts = np.resize(rows, 60)
    values = np.repeat(np.random.default_rng(1).normal(size=(60, 3)), counts, axis=0)
    values = np.concatenate([values, np.repeat(values[-1:], 200, axis=0)])
    t = 0.01 * np.arange(len(values))
    own, _ = own_samples(t, values)
    np.testing.assert_allclose(own[:60], t[np.cumsum([0, *counts[:-1]])])
    assert np.median(np.diff(own)) == pytest.approx(0.01 * rows[0], abs=0.011)
    assert np.diff(own).max() < 0.01 * (max(rows) + 1.5)
    assert own_samples(t, values, repeated=False)[1] is values


def test_a_recording_says_which_signals_were_lines():
    rng, t = np.random.default_rng(2), 0.01 * np.arange(501)
    slow = drawn(t, 0.1 * np.arange(51), rng.normal(size=(51, 4)))
    parts = {"command": Samples(t, slow, "motors"), "rates": Samples(t, rng.normal(size=(501, 3)), "gyro")}
    found = record("log", parts)
    assert (len(found.signals["command"]), len(found.signals["rates"])) == (51, 501)
    (note,) = found.notes
    assert note.startswith("motors: values repeated, or lines between samples 0.1 s apart")
