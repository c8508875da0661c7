"""One constructed flight, exact in every record: position is chosen, all else follows from it by Newton and Euler."""

import gzip

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from writers import px4_topics, ulog

from hybrid_jax.flights.log import FlightLog
from hybrid_jax.vehicle import IRIS

DT = 0.01


@pytest.fixture
def written(tmp_path):
    """Writes bytes, text or the topics of a ULog, and returns the path."""

    def write(content, name="", packed=False):
        name = name or f"flight.{'csv' if isinstance(content, str) else 'log'}"
        content = ulog(content) if isinstance(content, dict) else content
        content = content.encode() if isinstance(content, str) else content
        (tmp_path / name).write_bytes(gzip.compress(content) if packed else content)
        return tmp_path / name

    return write


@pytest.fixture(scope="session")
def flight():
    """12 s of IRIS at 100 Hz with every axis in motion; the motors act on the interval that follows their sample."""
    fine = np.arange(-50, 2450) * DT / 2
    swings = [(1.0, 0.21, 0.0), (0.03, 0.9, 0.4), (0.002, 2.3, 1.0)]  # m, Hz, rad
    phases = np.array([0.0, 1.1, 2.3])
    swing = [size * np.sin(2 * np.pi * hertz * fine[:, None] + at + phases) for size, hertz, at in swings]
    path = CubicSpline(fine, np.sum(swing, axis=0) + 2.0)
    force = path(fine, 2) + np.array([0.0, 0.0, IRIS.gravity])
    yaw = 0.8 * np.sin(1.3 * fine) + 0.02 * np.sin(9 * fine)
    z = force / np.linalg.norm(force, axis=1, keepdims=True)
    y = np.cross(z, np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1))  # x is as near to the heading as z allows
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    q = np.roll(Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=2)).as_quat(), 1, axis=1)
    q *= np.cumprod([1.0, *np.sign((q[1:] * q[:-1]).sum(axis=1))])[:, None]
    attitude, slope = Rotation.from_quat(np.roll(q, -1, axis=1)), CubicSpline(fine, q)(fine, 1)
    omega = 2 * (attitude.inv() * Rotation.from_quat(np.roll(slope, -1, axis=1))).as_quat()[:, :3]
    omega *= np.linalg.norm(slope, axis=1, keepdims=True)
    inertia = np.array(IRIS.inertia)
    torque = inertia * CubicSpline(fine, omega)(fine, 1) + np.cross(omega, inertia * omega)
    arms, k = np.array(IRIS.rotor_positions), IRIS.thrust_coefficient
    mixer = np.stack([k * np.ones(4), k * arms[:, 1], -k * arms[:, 0], IRIS.torque_coefficient * np.array(IRIS.spin)])
    wrench = np.concatenate([IRIS.mass * np.linalg.norm(force, axis=1, keepdims=True), torque], axis=1)
    squares = np.linalg.solve(mixer, wrench.T).T[51:-49:2]
    assert squares.min() > 0
    x = np.concatenate([path(fine), q, path(fine, 1), omega], axis=1)
    # Motors of the middle of each interval are its mean, but for second order.
    return FlightLog(fine[50:-50:2], x[50:-50:2], np.sqrt(squares), "constructed")


@pytest.fixture(scope="session")
def topics(flight):
    return px4_topics(flight)
