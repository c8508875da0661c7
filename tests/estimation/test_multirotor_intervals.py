"""Intervals of a multirotor's terms, entry by entry, and of losses that weigh channels and outliers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pushes import Push, pushes

from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.disturbance import with_disturbance
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.estimation.least_squares import fit_least_squares
from hybrid_jax.estimation.uncertainty import covariance_of, intervals
from hybrid_jax.training.channels import Channel, ChannelLoss
from hybrid_jax.vehicle import IRIS

LEARN = ("Ix", "k_rotors", "drag")
ERRORS = np.arange(1, 9) / 100  # in the order of the leaves: Ix, drag, k_rotors
Z = 1.959964  # of 95 %, from the normal distribution's table


@pytest.mark.parametrize(("level", "z"), [(0.6826895, 1.0), (0.95, Z)])
@pytest.mark.parametrize("wrap", [lambda field: field, lambda field: Hybrid(field, Push(jnp.ones(2)))])
def test_every_entry_has_its_interval_in_si_units(wrap, level, z):
    found = intervals(wrap(rigid_body(IRIS, LEARN)), np.diag(ERRORS**2), level)
    drag, rotors = ([f"{name}[{i}]" for i in range(count)] for name, count in (("drag", 3), ("k_rotors", 4)))
    assert set(found) == {"Ix", *drag, *rotors}
    for name, error in zip(("Ix", *rotors), ERRORS[[0, 4, 5, 6, 7]], strict=True):
        value, low, high = found[name]  # held as a logarithm
        np.testing.assert_allclose([high / value, value / low], np.exp(z * error), rtol=1e-5)  # float32
    for name, error in zip(drag, ERRORS[1:4], strict=True):
        assert found[name].value == 0  # held in units of the vehicle's weight at 1 m/s
        np.testing.assert_allclose(found[name][1:], z * error * IRIS.mass * IRIS.gravity * np.array([-1, 1]), rtol=1e-5)


def test_a_matrix_has_rows_and_columns():
    found = intervals(rigid_body(IRIS, ("aerodynamic_moment",)), np.eye(9) * 1e-4)
    assert list(found) == [f"aerodynamic_moment[{i},{j}]" for i in range(3) for j in range(3)]


def test_a_disturbance_has_intervals_beside_the_parameters():
    field = Hybrid(with_disturbance(rigid_body(IRIS)), Push(jnp.ones(2)))
    found = intervals(field, np.eye(9) * 1e-4)
    assert list(found) == ["Ix", "Iy", "k", *(f"disturbance[{name}]" for name in ("vx", "vy", "vz", "wx", "wy", "wz"))]
    np.testing.assert_allclose(found["disturbance[wz]"], Z * 0.01 * np.array([0, -1, 1]), rtol=1e-5)  # float32


def weighed(windows, design, gains, scales, huber):
    """H⁻¹ M H⁻¹ of a linear problem in double precision, by derivatives of the whole loss."""
    n, _, p = design.shape
    with jax.enable_x64(True):
        shapes, truth = np.asarray(design).reshape(n, -1, 2, p), jnp.asarray(windows.x, float).reshape(n, -1, 2)

        def counted(gains):  # (n,)
            r = jnp.abs(truth - jnp.asarray(shapes) @ gains) / jnp.asarray(scales)
            one = r**2 if huber is None else jnp.where(r > huber, 2 * huber * r - huber**2, r**2)
            return one.sum(axis=(1, 2))

        gains = jnp.asarray(np.asarray(gains, float))
        scores = np.asarray(jax.jacfwd(counted)(gains))
        bread = np.linalg.inv(np.asarray(jax.hessian(lambda gains: counted(gains).sum())(gains)))
    return n / (n - p) * bread @ (scores.T @ scores) @ bread


@pytest.mark.parametrize("huber", [None, 0.8])
def test_a_loss_of_channels_has_its_own_covariance(huber):
    """In channels of one entry each a linear problem's loss is bent by the data alone, so the formula is exact."""
    windows, design = pushes(40, 0.1)
    objective = ChannelLoss((Channel(0, 1, 0.1), Channel(1, 2, 0.05)), huber)
    gains = np.array([0.7, -0.4]) if huber is None else fit_least_squares(Push(jnp.ones(2)), windows).field.gains
    found = covariance_of(Push(jnp.asarray(gains)), windows, error=objective.error)
    expected = weighed(windows, design, gains, np.array([0.1, 0.05]), huber)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * abs(expected).max())  # float32 sums
