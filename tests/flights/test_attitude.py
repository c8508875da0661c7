"""Frames and attitudes of flights whose answer is known."""

import numpy as np
import pytest

from hybrid_jax.flights import attitude
from hybrid_jax.flights.attitude import Frames, from_euler, mean_of_held, rotation_of
from hybrid_jax.flights.formats import raw

NED, LEVEL = Frames("NED", "FRD", "world"), np.array([[1.0, 0, 0, 0]])
NONE, DEG = np.zeros((1, 3)), np.pi / 180


def to_library(p, q, v, omega, frames):
    """By the conversion of readers, whose recordings become flights."""
    velocity = "body_velocity" if frames.velocity == "body" else "velocity"
    parts = {"position": p, "attitude": q, velocity: v, "rates": omega}
    parts = {name: raw.Samples(np.zeros(len(q)), values, name) for name, values in parts.items()}
    p, q, v, omega = (part.values for part in raw.turned(parts, frames.world, frames.body).values())
    return np.concatenate([p, q, rotation_of(q).apply(v) if frames.velocity == "body" else v, omega], axis=1)


def row(*numbers):
    return np.array([numbers], float)


def axes(x):
    """Where the body's forward, left and up point in the world."""
    return rotation_of(x[:, 3:7]).as_matrix()[0].T


def test_level_and_north_in_ned_is_level_and_north_in_enu():
    x = to_library(row(1, 2, -3), LEVEL, row(4, 5, -6), row(0.1, 0.2, 0.3), NED)
    np.testing.assert_allclose(x[0, :3], [2, 1, 3])  # east, north, up
    np.testing.assert_allclose(x[0, 7:10], [5, 4, 6])
    np.testing.assert_allclose(x[0, 10:], [0.1, -0.2, -0.3])
    np.testing.assert_allclose(axes(x), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12)  # nose north, left west
    x = to_library(NONE, from_euler(row(0, 0, 90 * DEG)), NONE, NONE, NED)  # yaw to the east is the identity
    np.testing.assert_allclose(np.abs(x[0, 3:7]), [1, 0, 0, 0], atol=1e-12)


def test_pitch_and_roll_in_frd():
    forward, left, up = axes(to_library(NONE, from_euler(row(0, 30 * DEG, 90 * DEG)), NONE, NONE, NED))
    np.testing.assert_allclose(forward, [np.sqrt(0.75), 0, 0.5], atol=1e-12)  # east and up
    np.testing.assert_allclose(left, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(up, [-0.5, 0, np.sqrt(0.75)], atol=1e-12)  # thrust brakes
    _, left, _ = axes(to_library(NONE, from_euler(row(20 * DEG, 0, 90 * DEG)), NONE, NONE, NED))
    assert left[2] == pytest.approx(np.sin(20 * DEG))


def test_body_velocity_is_rotated_into_the_world():
    q = from_euler(row(0, 0, 90 * DEG))
    x = to_library(NONE, q, row(3, 1, -2), NONE, Frames("NED", "FRD", "body"))  # forward, right, up
    np.testing.assert_allclose(x[0, 7:10], [3, -1, 2], atol=1e-12)  # east, south, up
    x = to_library(NONE, from_euler(row(0, 0, 90 * DEG)), row(3, 1, 2), NONE, Frames("ENU", "FLU", "body"))
    np.testing.assert_allclose(x[0, 7:10], [-1, 3, 2], atol=1e-12)


def test_euler_angles_turn_yaw_first():
    forward = rotation_of(from_euler(row(0, 90 * DEG, 90 * DEG))).apply([1.0, 0, 0])[0]
    np.testing.assert_allclose(forward, [0, 0, -1], atol=1e-12)  # z up: positive pitch is nose down
    left = rotation_of(from_euler(row(90 * DEG, 0, 90 * DEG))).apply([0.0, 1, 0])[0]
    np.testing.assert_allclose(left, [0, 0, 1], atol=1e-12)


def test_rates_between_are_the_rates_of_the_flight(flight):
    middle = 0.5 * (flight.x[1:, 10:] + flight.x[:-1, 10:])
    # Second order in the interval: ω̈ dt² / 12 with ω̈ up to some hundred rad/s³.
    np.testing.assert_allclose(attitude.rates_between(flight.t, flight.x[:, 3:7]), middle, atol=5e-3)


def test_attitudes_are_interpolated_at_constant_rate():
    q = from_euler(np.array([[0, 0, 0], [0, 0, 80 * DEG]]))
    found = attitude.interpolate_attitude(np.array([0.25]), np.array([0.0, 1]), q)
    np.testing.assert_allclose(found, from_euler(row(0, 0, 20 * DEG)))


def test_held_values_are_averaged_over_intervals():
    at, values = np.array([0.0, 1, 2, 3]), np.array([[1.0], [2], [4], [8]])
    np.testing.assert_allclose(mean_of_held(np.array([0.0, 2, 3]), at, values), [[1.5], [4], [8]])
    np.testing.assert_allclose(mean_of_held(np.array([0.5, 1.0, 1.5, 3.5]), at, values), [[1], [2], [4.5], [8]])
    np.testing.assert_allclose(mean_of_held(np.array([1.2]), at, values), [[2]])
