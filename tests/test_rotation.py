"""Laws of quaternion algebra, in double precision so that a wrong sign cannot hide in round-off."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from hybrid_jax import rotation

pytestmark = pytest.mark.usefixtures("double_precision")  # laws hold to round-off

# Round-off of a few dozen float64 operations on numbers of at most 100.
CLOSE = {"rtol": 0, "atol": 1e-12}
number = st.floats(-3, 3, allow_subnormal=False)
vectors = st.tuples(number, number, number).map(np.array)
quick = settings(max_examples=40, deadline=None)


@st.composite
def units(draw):
    q = np.array(draw(st.tuples(number, number, number, number)))
    assume(np.linalg.norm(q) > 0.1)
    return q / np.linalg.norm(q)


def matrix(q):
    """The rotation matrix of a unit quaternion, from its axis and angle by Rodrigues' formula."""
    half = np.arctan2(np.linalg.norm(q[1:]), q[0])
    axis = q[1:] / max(np.linalg.norm(q[1:]), 1e-300)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(2 * half) * cross + (1 - np.cos(2 * half)) * cross @ cross


@given(units(), units(), vectors)
@quick
def test_rotate_is_the_rotation_matrix_keeps_length_and_by_a_product_turns_by_one_and_then_the_other(q, b, v):
    turned = rotation.rotate(jnp.asarray(q), jnp.asarray(v))
    np.testing.assert_allclose(turned, matrix(q) @ v, **CLOSE)
    np.testing.assert_allclose(np.array(rotation.matrix(jnp.asarray(q))) @ v, turned, **CLOSE)
    np.testing.assert_allclose(np.linalg.norm(turned), np.linalg.norm(v), **CLOSE)
    b, v = jnp.asarray(b), jnp.asarray(v)
    by_both = rotation.rotate(rotation.multiply(b, jnp.asarray(q)), v)
    np.testing.assert_allclose(by_both, rotation.rotate(b, turned), **CLOSE)


@given(units(), vectors)
@quick
def test_derivative_is_the_limit_of_a_finite_rotation_about_a_body_axis(q, rates):
    speed, h = np.linalg.norm(rates), 1e-5
    assume(speed > 0.1)

    def after(seconds):
        turn = rotation.from_axis_angle(jnp.asarray(rates / speed), jnp.asarray(speed * seconds))
        return rotation.multiply(jnp.asarray(q), turn)

    slope = (after(h) - after(-h)) / (2 * h)
    # Central difference: h² |ω|³ / 48 = 3e-10 from the curvature, 1e-16 / h = 1e-11 from round-off.
    np.testing.assert_allclose(rotation.derivative(jnp.asarray(q), jnp.asarray(rates)), slope, rtol=0, atol=1e-9)


AXES = np.random.default_rng(0).normal(size=(20, 3))
AXES = AXES / np.linalg.norm(AXES, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-4, 0.5, 2.0, 3.1])
def test_rotation_vector_is_axis_times_angle(angle):
    for axis in AXES:
        q = rotation.from_axis_angle(jnp.array(axis), jnp.array(angle))
        # sin and cos of half the angle are rounded to 6e-8.
        for same in (q, -q, 3 * q):
            np.testing.assert_allclose(rotation.rotation_vector(same), angle * axis, rtol=0, atol=1e-6)


def test_rotation_vector_has_the_derivative_of_a_small_rotation_and_half_a_turn_one_that_is_not_zero():
    for angle in (0.0, 1e-5, 1.0):
        here = rotation.from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.array(angle))
        turned = partial(rotation.multiply, here)
        slope = jax.jacfwd(lambda v, by=turned: rotation.rotation_vector(by(jnp.append(1.0, v / 2))))(jnp.zeros(3))
        np.testing.assert_allclose(slope[2], [0, 0, 1], rtol=0, atol=1e-5)  # about the axis of the turn
    assert np.isfinite(slope).all()
    wanted, opposite = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(rotation.attitude_error(wanted, opposite), [0, 0, np.pi], rtol=1e-6)
    slope = jax.grad(lambda w: rotation.attitude_error(wanted, jnp.array([0.0, 0.0, 0.0, 1.0]).at[0].set(w))[2])(0.0)
    assert slope == pytest.approx(-2.0, rel=1e-5)  # angle = 2 arctan(1 / w)


def test_heading_is_the_first_of_the_z_y_x_angles():
    z, y, x = map(rotation.from_axis_angle, jnp.eye(3)[::-1], jnp.array([2.5, 0.7, -0.4]))
    q = rotation.multiply(rotation.multiply(z, y), x)
    np.testing.assert_allclose(rotation.heading(jnp.stack([q, -q])), 2.5, rtol=1e-6)
