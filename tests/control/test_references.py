"""Laws of reference states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.control import Controller, add_body_rates, figure_eight, hover, low_flyby, sample, step
from hybrid_jax.rotation import body_z, heading, normalise

CONTROLLER = Controller(hj.IRIS)
DT = CONTROLLER.period


def spiral(t):
    return jnp.stack([jnp.sin(t), jnp.cos(2 * t), 0.3 * t**2]), jnp.sin(2 * t)


@pytest.fixture(scope="module")
def states():
    with jax.enable_x64(True):
        return np.asarray(sample(spiral, CONTROLLER, 1.0))


def test_samples_cover_the_last_horizon(states):
    assert len(states) == 100 + CONTROLLER.steps * CONTROLLER.stride + 1
    horizon = CONTROLLER.horizon(jnp.asarray(states), 100)
    np.testing.assert_allclose(horizon[-1], states[-1], rtol=1e-6)
    np.testing.assert_allclose(horizon[0], states[105], rtol=1e-6)
    refusal(lambda: CONTROLLER.horizon(jnp.asarray(states), 101), "i ≤ 100; got 101")
    refusal(lambda: CONTROLLER.horizon(jnp.asarray(states), -1), "i must be an integer of at least 0, got -1")


def test_velocity_and_rates_are_derivatives(states):
    # Central differences of second order: 1e-4 of the third derivatives, which are below 20.
    np.testing.assert_allclose((states[2:, :3] - states[:-2, :3]) / (2 * DT), states[1:-1, 7:10], rtol=0, atol=1e-3)
    turning = (states[2:, 3:7] - states[:-2, 3:7]) / (2 * DT)
    found = np.array([hj.rigid_body(hj.IRIS)(x, np.zeros(4, np.float32))[3:7] for x in states[1:-1:10]])
    np.testing.assert_allclose(turning[::10], found, rtol=0, atol=2e-3)


def test_attitude_follows_acceleration_and_yaw(states):
    acceleration = (states[2:, 7:10] - states[:-2, 7:10]) / (2 * DT) + [0, 0, hj.IRIS.gravity]
    asked = acceleration / np.linalg.norm(acceleration, axis=1, keepdims=True)
    np.testing.assert_allclose(np.asarray(body_z(states[1:-1, 3:7].T)).T, asked, rtol=0, atol=1e-3)
    np.testing.assert_allclose(heading(jnp.asarray(states[:, 3:7])), np.sin(2 * DT * np.arange(len(states))), atol=1e-6)
    np.testing.assert_allclose(normalise(states[:, 3:7]), states[:, 3:7], atol=1e-6)


@pytest.mark.parametrize("speed", [3.5, 6.0])
def test_figure_eight_reaches_its_top_speed(speed):
    flown = np.linalg.norm(sample(figure_eight(speed), CONTROLLER, 10.0)[:, 7:10], axis=1)
    assert flown.max() == pytest.approx(speed, rel=1e-3)
    assert flown.min() > 0.3 * speed


def test_hover_and_step_have_zero_velocity():
    samples = sample(step(to=(2.0, 0.0, 1.0), at=0.5, yaw=1.0, altitude=1.5), CONTROLLER, 1.0)
    np.testing.assert_array_equal(samples[:, 7:], 0)
    np.testing.assert_allclose(samples[0], sample(hover((0.0, 0.0, 1.5)), CONTROLLER, 1.0)[0])
    np.testing.assert_allclose(samples[-1], sample(hover((2.0, 0.0, 2.5), yaw=1.0), CONTROLLER, 1.0)[0], atol=1e-6)


def test_low_flyby_is_low_for_two_fifths_of_the_time():
    altitude = np.asarray(sample(low_flyby(low=0.15, high=1.0, every=5.0), CONTROLLER, 9.0)[:, 2])
    assert altitude.min() == pytest.approx(0.15, abs=1e-4)
    assert altitude.max() == pytest.approx(1.0, abs=1e-4)
    assert np.mean(altitude < 0.15 + 0.085) == pytest.approx(0.4, abs=0.03)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: hover((0.0, 0.0)), r"position must be three numbers \(x, y, z\), got \(0.0, 0.0\)"),
        (lambda: hover((0.0, 0.0, np.nan)), r"position\[2\] is not finite"),
        (lambda: hover(yaw=np.inf), "yaw must be a finite number"),
        (lambda: low_flyby(low=1.0, high=0.5), "high"),
        (lambda: sample(hover(), CONTROLLER, -1.0), "duration"),
        (lambda: figure_eight(0.0), "top_speed"),
        (lambda: add_body_rates(jnp.zeros(4)), r"state \(13,\) expected"),
        (lambda: sample(None, CONTROLLER, 1.0), "path must be a function of time"),
    ],
)
def test_invalid_arguments_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
