"""Laws of a rigid body with weakened rotors and added drag; and of its actuators: lag, curve, voltage and delay."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal

import hybrid_jax as hj
from experiments.flying.changes import DOUBLED_DRAG, LOADED, WEAK_ROTOR, loaded
from hybrid_jax.dynamics.actuators import Actuator, actuated, held_means, rotor_speeds
from hybrid_jax.dynamics.disturbance import disturbance_of, with_disturbance, without_zeros
from hybrid_jax.dynamics.rigid_body import corrected, hold_corrections, uncorrected
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.export.program import sizes_of
from hybrid_jax.rotation import from_axis_angle
from hybrid_jax.sim.domain import SOURCE

KNOWN = Terms(drag=(0.3, 0.2, 0.1))
BODY = hj.rigid_body(hj.IRIS)
U = jnp.array([640.0, 660.0, 650.0, 630.0])


def changed(efficiency=(1.0, 1.0, 1.0, 1.0), drag=0.0, reaction=1.0):
    factors = {"efficiency": efficiency, "reaction_torque": reaction}
    deviations = {name: jnp.log(jnp.array(each)) for name, each in factors.items()} | {"added_drag": jnp.full(3, drag)}
    return hj.RigidBody(corrected(BODY).deviations | deviations, hj.IRIS)


def moving():
    tilted = from_axis_angle(jnp.array([0.6, 0.8, 0.0]), jnp.asarray(0.4))
    return jnp.zeros(13).at[2].set(50.0).at[3:7].set(tilted).at[7:].set(jnp.array([1, -2, 0.5, 0.3, -0.2, 0.1]))


def test_without_a_change_it_is_the_body_and_is_simplified_to_it_and_held_corrections_are_no_parameters():
    larger = corrected(hj.Hybrid(BODY, hj.residual_network(13, 4, jax.random.key(0), hidden=4)))
    assert eqx.tree_equal(larger.physics, changed())
    np.testing.assert_array_equal(larger.physics(moving(), U), BODY(moving(), U))
    assert eqx.tree_equal(uncorrected(without_zeros(with_disturbance(larger))).physics, BODY)
    weak = changed((0.9, 1, 1, 1))
    assert eqx.tree_equal(uncorrected(weak), weak)
    weak = changed((0.85, 1, 1, 1), 0.3)
    held = hold_corrections(weak)
    np.testing.assert_allclose(held(moving(), U), weak(moving(), U), rtol=1e-6)
    assert [*named_parameters(held)] == [*named_parameters(BODY)]
    assert len(ravel_parameters(held)[0]) == len(ravel_parameters(BODY)[0])


def test_an_efficiency_is_a_factor_on_thrust_and_reaction_torque_which_has_one_of_its_own():
    weak = changed((0.85, 1, 1, 1))
    slower = U.at[0].multiply(np.sqrt(0.85))  # both go with the square of the speed
    np.testing.assert_allclose(weak(moving(), U), BODY(moving(), slower), rtol=1e-6, atol=1e-6)
    other = hj.rigid_body(replace(hj.IRIS, torque_coefficient=1.6 * hj.IRIS.torque_coefficient))
    np.testing.assert_allclose(changed(reaction=1.6)(moving(), U), other(moving(), U), rtol=1e-6)


@pytest.mark.parametrize(("domain", "efficiency", "drag"), [(WEAK_ROTOR, 0.85, 1), (DOUBLED_DRAG, 1.0, 2)])
def test_it_can_be_what_the_simulator_flies(domain, efficiency, drag):
    """Far above the ground, where ground effect is none."""
    field = changed((efficiency, 1, 1, 1), drag * SOURCE.drag_coefficient / hj.IRIS.mass)
    with jax.enable_x64(True):
        x, u = moving().astype(float), U.astype(float)
        after = domain.quadrotor().step(x, u, jnp.zeros(()), 1e-4)
        np.testing.assert_allclose((after - x)[7:] / 1e-4, field(x, u)[7:], rtol=2e-3, atol=2e-3)


def test_in_a_wind_the_accelerations_are_those_at_the_velocity_through_the_air():
    names, wind = ("drag", "rotor_drag", "aerodynamic_moment", "translational_lift"), jnp.array([2.0, -3.0, 0.5])
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


LAGGING = Actuator((100.0, 900.0), time_constants=(0.04, 0.08))
DRIVEN = hj.rigid_body(hj.IRIS, ("Ix", "k_rotors"))
LEVEL = np.eye(13)[3]


@pytest.mark.parametrize(("step", "tau"), [(0.2, 0.04), (-0.2, 0.08)])
def test_a_step_is_followed_by_a_share_of_1_minus_1_over_e_after_the_time_constant_of_its_direction(step, tau):
    field = actuated(DRIVEN, LAGGING)
    u = np.full((100, 4), 0.5 + step)
    x0 = np.concatenate([LEVEL, np.full(4, 550.0)])
    w = np.asarray(hj.rollout(field, x0, u, 0.002))[round(tau / 0.002) - 1, 13:]
    np.testing.assert_allclose(w, 550 + 900 * step * (1 - np.exp(-1)), rtol=1e-4)


def test_in_the_steady_state_a_commanded_vehicle_has_the_speeds_or_thrusts_of_its_curve():
    field = actuated(DRIVEN, LAGGING)
    u = jnp.array([0.4, 0.5, 0.6, 0.7])
    w = field.steady_speeds(u)
    np.testing.assert_allclose(w, 100 + 900 * u, rtol=1e-6)
    slope = field(jnp.concatenate([jnp.asarray(LEVEL), w]), u)
    np.testing.assert_array_equal(slope[:13], DRIVEN(jnp.asarray(LEVEL), w))
    np.testing.assert_allclose(slope[13:], 0, atol=1e-2)
    instant = actuated(DRIVEN, replace(LAGGING, time_constants=0.0))
    np.testing.assert_array_equal(instant(jnp.asarray(LEVEL), u), slope[:13])
    assert (field.state_size, instant.state_size) == (17, 13)
    thrust = Actuator((0.5, 0.0, 8.0), "thrust", nominal_voltage=12.0, voltage_exponent=0.5)
    field = actuated(hj.rigid_body(hj.IRIS, ()), thrust)
    w = field.steady_speeds(jnp.array([0.3, 0.4, 0.5, 0.6, 10.0]))
    share = jnp.array([0.3, 0.4, 0.5, 0.6]) * (10 / 12) ** 0.5
    np.testing.assert_allclose(hj.IRIS.thrust_coefficient * w**2, 0.5 + 8 * share**2, rtol=1e-5)
    assert field.input_size == 5


def test_the_filter_before_a_window_agrees_with_the_solver():
    field, rng = actuated(DRIVEN, LAGGING), np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.3, 0.8, (10, 4)), 10, axis=0)
    with jax.enable_x64(True):
        x0 = np.concatenate([LEVEL, field.steady_speeds(jnp.asarray(u[0]))])
        last = hj.rollout(field, x0, u, 0.002)[-1, 13:]
        np.testing.assert_allclose(field.settled(jnp.asarray(u), 0.002), last, rtol=1e-6)


def test_a_delay_shifts_commands_and_a_log_of_them_becomes_one_of_mean_speeds():
    t, values = np.arange(20) * 0.1, np.random.default_rng(0).random((20, 2))
    edges = 0.1 * np.arange(5, 15)
    np.testing.assert_allclose(held_means(t, values, edges, 0.2), values[3:12], atol=1e-5)
    half = held_means(t, values, edges, 0.05)
    np.testing.assert_allclose(half, (values[4:13] + values[5:14]) / 2, atol=1e-5)
    field = actuated(DRIVEN, replace(LAGGING, time_constants=0.05))
    u = np.concatenate([np.full((30, 4), 0.4), np.full((30, 4), 0.6)])
    t = 0.01 * np.arange(60)
    speeds = rotor_speeds(field, t, u, 0.01 * np.arange(61))
    after = 0.01 * np.arange(31)
    ends = 640 - 180 * np.exp(-after / 0.05)
    means = 640 - (ends[1:] - ends[:-1]) * 0.05 / 0.01
    np.testing.assert_allclose(speeds[30:], means[:, None] * np.ones(4), rtol=1e-4)


def test_a_commanded_field_is_saved_exported_and_disturbed_and_malformed_actuators_are_refused(tmp_path):
    field = actuated(hj.rigid_body(hj.IRIS, ("Ix",)), LAGGING, ("curve", "time_constants", "delay"))
    hj.save(tmp_path / "model.npz", field)
    loaded = hj.load(tmp_path / "model.npz").field
    assert named_parameters(loaded).keys() >= {"curve[1]", "time_constants[0]", "delay", "Ix"}
    assert sizes_of(loaded, None, None) == (17, 4)
    assert disturbance_of(hj.with_disturbance(field)).indices == tuple(range(7, 13))
    refusal(lambda: replace(LAGGING, curve=(1.0,)), "two to six")
    refusal(lambda: replace(LAGGING, gives="torque"), "speed, thrust")
    refusal(lambda: replace(LAGGING, voltage_exponent=1.0), "nominal_voltage")
    refusal(lambda: actuated(DRIVEN, LAGGING, ("gain",)), "'gain'")
    refusal(lambda: actuated(DRIVEN, LAGGING, ("curve",)), "k_rotors")
