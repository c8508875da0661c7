"""Laws of attitude errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybrid_jax.control.attitude import attitude_error, canonicalize_quaternion, heading, rotation_vector
from hybrid_jax.rotation import from_axis_angle, multiply

AXES = np.random.default_rng(0).normal(size=(20, 3))
AXES = AXES / np.linalg.norm(AXES, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-4, 0.5, 2.0, 3.1])
def test_rotation_vector_is_axis_times_angle(angle):
    for axis in AXES:
        q = from_axis_angle(jnp.array(axis), jnp.array(angle))
        # sin and cos of half the angle are rounded to 6e-8.
        for same in (q, -q, 3 * q):
            np.testing.assert_allclose(rotation_vector(same), angle * axis, rtol=0, atol=1e-6)


def test_rotation_vector_has_the_derivative_of_a_small_rotation():
    for angle in (0.0, 1e-5, 1.0):
        here = from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.array(angle))
        slope = jax.jacfwd(
            lambda turn, here=here: rotation_vector(multiply(here, jnp.concatenate([jnp.ones(1), turn / 2])))
        )(jnp.zeros(3))
        np.testing.assert_allclose(slope[2], [0, 0, 1], rtol=0, atol=1e-5)  # about the axis of the turn
    assert np.isfinite(slope).all()


def test_half_a_turn_has_a_nonzero_derivative():
    wanted, opposite = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(attitude_error(wanted, opposite), [0, 0, np.pi], rtol=1e-6)
    slope = jax.grad(lambda w: attitude_error(wanted, jnp.array([0.0, 0.0, 0.0, 1.0]).at[0].set(w))[2])(0.0)
    assert slope == pytest.approx(-2.0, rel=1e-5)  # angle = 2 arctan(1 / w)


def test_q_and_minus_q_have_one_canonical_form():
    quaternions = np.concatenate([np.random.default_rng(1).normal(size=(20, 4)), np.eye(4)]).astype(np.float32)
    for q in quaternions:
        one = canonicalize_quaternion(jnp.array(q))
        np.testing.assert_array_equal(one, canonicalize_quaternion(jnp.array(-q)))
        np.testing.assert_array_equal(np.abs(one), np.abs(q))
        assert one[0] >= 0


def test_heading_is_the_first_of_the_z_y_x_angles():
    turns = [
        from_axis_angle(jnp.array(axis), jnp.array(angle))
        for axis, angle in zip(np.eye(3)[::-1], (2.5, 0.7, -0.4), strict=True)
    ]
    q = multiply(multiply(turns[0], turns[1]), turns[2])
    np.testing.assert_allclose(heading(jnp.stack([q, -q])), 2.5, rtol=1e-6)
