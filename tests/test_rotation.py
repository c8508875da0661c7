"""Laws of quaternion algebra, in double precision so that a wrong sign cannot hide in round-off."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from hybrid_jax import rotation

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


@pytest.fixture(autouse=True, scope="module")
def double_precision():
    with jax.enable_x64(True):
        yield


def matrix(q):
    """The rotation matrix of a unit quaternion, from its axis and angle by Rodrigues' formula."""
    half = np.arctan2(np.linalg.norm(q[1:]), q[0])
    axis = q[1:] / max(np.linalg.norm(q[1:]), 1e-300)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(2 * half) * cross + (1 - np.cos(2 * half)) * cross @ cross


@given(units(), vectors)
@quick
def test_rotate_is_the_rotation_matrix_and_keeps_length(q, v):
    turned = rotation.rotate(jnp.asarray(q), jnp.asarray(v))
    np.testing.assert_allclose(turned, matrix(q) @ v, **CLOSE)
    np.testing.assert_allclose(np.linalg.norm(turned), np.linalg.norm(v), **CLOSE)


@given(units(), units(), vectors)
@quick
def test_the_product_turns_by_one_and_then_the_other(a, b, v):
    a, b, v = map(jnp.asarray, (a, b, v))
    one_by_one = rotation.rotate(a, rotation.rotate(b, v))
    np.testing.assert_allclose(rotation.rotate(rotation.multiply(a, b), v), one_by_one, **CLOSE)


@given(units(), units(), units())
@quick
def test_unit_quaternions_are_a_group(a, b, c):
    a, b, c = map(jnp.asarray, (a, b, c))
    product = rotation.multiply
    np.testing.assert_allclose(product(product(a, b), c), product(a, product(b, c)), **CLOSE)
    np.testing.assert_allclose(product(a, rotation.conjugate(a)), [1, 0, 0, 0], **CLOSE)
    np.testing.assert_allclose(product(a, jnp.array([1.0, 0, 0, 0])), a, **CLOSE)
    np.testing.assert_allclose(jnp.linalg.norm(product(a, b)), 1, **CLOSE)


@given(units())
@quick
def test_body_z_is_the_third_axis(q):
    expected = rotation.rotate(jnp.asarray(q), jnp.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(rotation.body_z(jnp.asarray(q)), expected, **CLOSE)


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


@given(units(), st.floats(0.01, 100))
@quick
def test_normalise_gives_the_unit_quaternion_of_the_same_direction(q, length):
    rows = jnp.stack([jnp.asarray(q) * length, jnp.asarray(q)])
    np.testing.assert_allclose(rotation.normalise(rows), [q, q], **CLOSE)
