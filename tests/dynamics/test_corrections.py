"""Laws of a rigid body with weakened rotors and added drag."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from experiments.flying.changes import DOUBLED_DRAG, LOADED, WEAK_ROTOR, loaded
from hybrid_jax.dynamics.disturbance import with_disturbance, without_zeros
from hybrid_jax.dynamics.rigid_body import corrected, hold_corrections, uncorrected
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.rotation import from_axis_angle
from hybrid_jax.sim.domain import SOURCE

KNOWN = Terms(drag=(0.3, 0.2, 0.1))
BODY = hj.rigid_body(hj.IRIS)
U = jnp.array([640.0, 660.0, 650.0, 630.0])


def changed(efficiency=(1.0, 1.0, 1.0, 1.0), drag=0.0, reaction=1.0):
    factors = {"efficiency": efficiency, "reaction_torque": reaction}
    deviations = {name: jnp.log(jnp.array(each)) for name, each in factors.items()} | {"added_drag": jnp.full(3, drag)}
    return hj.RigidBody(BODY.deviations | deviations, hj.IRIS)


def moving():
    tilted = from_axis_angle(jnp.array([0.6, 0.8, 0.0]), jnp.asarray(0.4))
    return jnp.zeros(13).at[2].set(50.0).at[3:7].set(tilted).at[7:].set(jnp.array([1, -2, 0.5, 0.3, -0.2, 0.1]))


def test_without_a_change_it_is_the_body_and_is_simplified_to_it():
    larger = corrected(hj.Hybrid(BODY, hj.residual_network(13, 4, jax.random.key(0), hidden=4)))
    assert eqx.tree_equal(larger.physics, changed())
    np.testing.assert_array_equal(larger.physics(moving(), U), BODY(moving(), U))
    assert eqx.tree_equal(uncorrected(without_zeros(with_disturbance(larger))).physics, BODY)
    weak = changed((0.9, 1, 1, 1))
    assert eqx.tree_equal(uncorrected(weak), weak)


def test_held_corrections_act_and_are_no_parameters():
    weak = changed((0.85, 1, 1, 1), 0.3)
    held = hold_corrections(weak)
    np.testing.assert_allclose(held(moving(), U), weak(moving(), U), rtol=1e-6)
    assert [*named_parameters(held)] == [*named_parameters(BODY)]
    assert len(ravel_parameters(held)[0]) == len(ravel_parameters(BODY)[0])


def test_an_efficiency_is_a_factor_on_thrust_and_reaction_torque():
    weak = changed((0.85, 1, 1, 1))
    slower = U.at[0].multiply(np.sqrt(0.85))  # both go with the square of the speed
    np.testing.assert_allclose(weak(moving(), U), BODY(moving(), slower), rtol=1e-6, atol=1e-6)


def test_a_factor_of_the_reaction_torque_is_one_of_its_coefficient():
    other = hj.rigid_body(replace(hj.IRIS, torque_coefficient=1.6 * hj.IRIS.torque_coefficient))
    np.testing.assert_allclose(changed(reaction=1.6)(moving(), U), other(moving(), U), rtol=1e-6)


@pytest.mark.parametrize(
    ("domain", "efficiency", "drag"),
    [(WEAK_ROTOR, 0.85, SOURCE.drag_coefficient / hj.IRIS.mass), (DOUBLED_DRAG, 1.0, None)],
    ids=["weak rotor", "doubled drag"],
)
def test_it_can_be_what_the_simulator_flies(domain, efficiency, drag):
    """Far above the ground, where ground effect is none."""
    c = 2 * SOURCE.drag_coefficient / hj.IRIS.mass if drag is None else drag
    field = changed((efficiency, 1, 1, 1), c)
    with jax.enable_x64(True):
        x, u = moving().astype(float), U.astype(float)
        after = domain.quadrotor().step(x, u, jnp.zeros(()), 1e-4)
        np.testing.assert_allclose((after - x)[7:] / 1e-4, field(x, u)[7:], rtol=2e-3, atol=2e-3)


def test_in_a_wind_the_accelerations_are_those_at_the_velocity_through_the_air():
    names, wind = ("drag", "aerodynamic_moment", "translational_lift"), jnp.array([2.0, -3.0, 0.5])
    deviations = {name: 0.01 * (1 + leaf) for name, leaf in hj.rigid_body(hj.IRIS, names).deviations.items()}
    body, x = hj.RigidBody(deviations, hj.IRIS), moving()
    windy = hj.RigidBody(deviations | {"wind": wind, "added_drag": jnp.full(3, 0.2)}, hj.IRIS)
    still = hj.RigidBody(deviations | {"added_drag": jnp.full(3, 0.2)}, hj.IRIS)
    np.testing.assert_allclose(windy(x, U)[3:], still(x.at[7:10].add(-wind), U)[3:], rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(windy(x, U)[:3], x[7:10])
    assert jnp.abs(windy(x, U) - still(x, U))[7:].min() > 1e-3
    has_wind = ["wind" in corrected(each).deviations for each in (body, hj.rigid_body(hj.IRIS, (), KNOWN), BODY)]
    assert has_wind == [True, True, False]  # nothing tells of the air around a body without aerodynamics


def test_a_load_moves_the_centre_of_mass_and_adds_to_the_inertia():
    place, mass = np.array([0.04, 0.03, -0.05]), 0.3
    centre = mass / (hj.IRIS.mass + mass) * place
    assert LOADED.mass == hj.IRIS.mass + mass
    np.testing.assert_allclose(LOADED.rotor_positions, np.asarray(hj.IRIS.rotor_positions) - centre[:2])
    # Two point masses about their centre of mass: the reduced mass times the square of the distance from each axis.
    added = hj.IRIS.mass * mass / LOADED.mass * (place @ place - place**2)
    np.testing.assert_allclose(np.asarray(LOADED.inertia) - hj.IRIS.inertia, added, rtol=1e-9)
    np.testing.assert_allclose(loaded(hj.IRIS, 0.5, (0.0, 0.0, 0.0)).inertia, hj.IRIS.inertia)


def test_a_hybrid_model_is_the_same_for_both_quaternions_of_an_attitude():
    hybrid = hj.Hybrid(changed(), hj.residual_network(13, 4, jax.random.key(0)))
    x, other = moving(), jnp.ones(13).at[3:7].set(-1.0)
    np.testing.assert_array_equal(hybrid(other * x, U), other * hybrid(x, U))
    columns = [hybrid.parameter_columns(at, U) for at in (x, other * x)]
    np.testing.assert_array_equal(columns[1], other[:, None] * columns[0])
