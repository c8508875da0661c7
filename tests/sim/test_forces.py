"""Laws of the forces that the physics model does not know."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.flying.changes import gusty_wind
from hybrid_jax.rotation import from_axis_angle
from hybrid_jax.sim.forces import ground_effect, parameters_of, rotor_altitudes, thrust_gain, wind
from hybrid_jax.vehicle import IRIS

pytestmark = pytest.mark.usefixtures("double_precision")
T0 = jnp.asarray(0.0)
U = jnp.array([600.0, 650.0, 700.0, 620.0])


def hovering(altitude, tilt=0.0, axis=(1.0, 0.0, 0.0)):
    attitude = from_axis_angle(jnp.array(axis), jnp.asarray(tilt))
    return jnp.zeros(13).at[2].set(altitude).at[3:7].set(attitude)


@pytest.mark.parametrize(("altitude", "percent"), [(0.1, 11.41), (0.2, 2.63), (0.5, 0.411)])
def test_level_thrust_gains_what_cheeseman_and_bennett_say(altitude, percent):
    wrench = ground_effect(hovering(altitude), U, T0, parameters_of(IRIS))
    free = IRIS.thrust_coefficient * float((U**2).sum())
    assert 100 * float(wrench.force[2]) / free == pytest.approx(percent, abs=0.005)
    np.testing.assert_array_equal(wrench.force[:2], 0)


def test_the_gain_stays_finite_below_half_a_radius():
    radius = jnp.asarray(IRIS.rotor_radius)
    gains = thrust_gain(jnp.array([0.5, 0.25, 0.1, 0.0, -3.0]) * radius, radius)
    np.testing.assert_allclose(gains, 4 / 3)


def test_a_tilted_rotor_has_its_own_altitude_and_pushes_the_low_side_up():
    tilted = hovering(0.3, tilt=0.5)  # about x: the left rotors (y > 0) rise
    altitudes = rotor_altitudes(tilted, parameters_of(IRIS).rotor_positions)
    np.testing.assert_allclose(altitudes, [0.3 + np.sin(0.5) * y for _, y in IRIS.rotor_positions])
    assert float(ground_effect(tilted, jnp.full(4, 650.0), T0, parameters_of(IRIS)).torque[0]) < -0.01


def test_ground_effect_turns_with_the_vehicle():
    u, above = jnp.array([600.0, 800.0, 800.0, 600.0]), (hovering(0.3), hovering(0.3, jnp.pi / 2, (0.0, 0.0, 1.0)))
    straight, turned = (ground_effect(x, u, T0, parameters_of(IRIS)).torque for x in above)
    assert float(jnp.abs(straight[0])) > 1e-2
    np.testing.assert_allclose(turned, [-straight[1], straight[0], straight[2]], atol=1e-15)


@pytest.mark.parametrize(("t", "force"), [(0.0, -4.0), (0.75, -3.0), (2.25, -5.0), (3.75, -3.0)])
def test_wind_blows_along_y_with_a_period_of_three_seconds(t, force):
    found = wind(hovering(1.0), U, jnp.asarray(t), parameters_of(IRIS)).force
    np.testing.assert_allclose(found, [0, force, 0], atol=1e-14)


def test_gusts_come_and_go_about_a_mean():
    times = jnp.linspace(0.0, 2000.0, 40_001)
    blown = jax.vmap(lambda t: gusty_wind(hovering(1.0), U, t, parameters_of(IRIS)).force)(times)
    np.testing.assert_allclose(blown.mean(axis=0), [2.0, -2.5, 0.6], atol=0.01)
    np.testing.assert_allclose(blown.std(axis=0), np.sqrt([0.445, 0.445, 0.065]), rtol=0.02)  # two sines each
