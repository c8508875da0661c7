"""Actuators: laws of the lag, the static curve, the voltage and the delay."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.dynamics.actuators import Actuator, actuated, held_means, rotor_speeds
from hybrid_jax.dynamics.disturbance import disturbance_of
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.export.program import sizes_of
from hybrid_jax.vehicle import IRIS

LAGGING = Actuator((100.0, 900.0), time_constants=(0.04, 0.08))
BODY = hj.rigid_body(IRIS, ("Ix", "k_rotors"))
LEVEL = np.zeros(13)
LEVEL[3] = 1


def flown(field, u, dt=0.002):
    """Rotor speeds of a field that begins level with rotors at the first command's speed."""
    x0 = jnp.concatenate([jnp.asarray(LEVEL), field.steady_speeds(jnp.asarray(u[0]))])
    return np.asarray(hj.rollout(field, x0, u, dt))[:, 13:]


@pytest.mark.parametrize(("step", "tau"), [(0.2, 0.04), (-0.2, 0.08)])
def test_a_step_is_followed_by_a_share_of_1_minus_1_over_e_after_the_time_constant_of_its_direction(step, tau):
    field = actuated(BODY, LAGGING)
    u = np.full((100, 4), 0.5 + step)
    x0 = np.concatenate([LEVEL, np.full(4, 550.0)])
    w = np.asarray(hj.rollout(field, x0, u, 0.002))[round(tau / 0.002) - 1, 13:]
    np.testing.assert_allclose(w, 550 + 900 * step * (1 - np.exp(-1)), rtol=1e-4)


def test_in_the_steady_state_a_commanded_vehicle_is_the_one_that_is_told_the_speeds_of_the_curve():
    field = actuated(BODY, LAGGING)
    u = jnp.array([0.4, 0.5, 0.6, 0.7])
    w = field.steady_speeds(u)
    np.testing.assert_allclose(w, 100 + 900 * u, rtol=1e-6)
    slope = field(jnp.concatenate([jnp.asarray(LEVEL), w]), u)
    np.testing.assert_array_equal(slope[:13], BODY(jnp.asarray(LEVEL), w))
    np.testing.assert_allclose(slope[13:], 0, atol=1e-2)
    instant = actuated(BODY, replace(LAGGING, time_constants=0.0))
    np.testing.assert_array_equal(instant(jnp.asarray(LEVEL), u), slope[:13])
    assert (field.state_size, instant.state_size) == (17, 13)


def test_a_curve_of_thrust_gives_that_thrust_and_a_voltage_acts_as_the_command_times_its_power():
    thrust = Actuator((0.5, 0.0, 8.0), "thrust", nominal_voltage=12.0, voltage_exponent=0.5)
    field = actuated(hj.rigid_body(IRIS, ()), thrust)
    w = field.steady_speeds(jnp.array([0.3, 0.4, 0.5, 0.6, 10.0]))
    share = jnp.array([0.3, 0.4, 0.5, 0.6]) * (10 / 12) ** 0.5
    np.testing.assert_allclose(IRIS.thrust_coefficient * w**2, 0.5 + 8 * share**2, rtol=1e-5)
    assert field.input_size == 5


def test_the_filter_before_a_window_agrees_with_the_solver():
    field, rng = actuated(BODY, LAGGING), np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.3, 0.8, (10, 4)), 10, axis=0)
    with jax.enable_x64(True):
        np.testing.assert_allclose(field.settled(jnp.asarray(u), 0.002), flown(field, u)[-1], rtol=1e-6)


def test_a_delay_shifts_commands_and_whole_intervals_are_found_again():
    t, values = np.arange(20) * 0.1, np.random.default_rng(0).random((20, 2))
    edges = 0.1 * np.arange(5, 15)
    np.testing.assert_allclose(held_means(t, values, edges, 0.2), values[3:12], atol=1e-5)
    half = held_means(t, values, edges, 0.05)
    np.testing.assert_allclose(half, (values[4:13] + values[5:14]) / 2, atol=1e-5)


def test_a_log_of_commands_becomes_one_of_the_mean_speeds_of_each_interval():
    field = actuated(BODY, replace(LAGGING, time_constants=0.05))
    u = np.concatenate([np.full((30, 4), 0.4), np.full((30, 4), 0.6)])
    t = 0.01 * np.arange(60)
    speeds = rotor_speeds(field, t, u, 0.01 * np.arange(61))
    after = 0.01 * np.arange(31)
    ends = 640 - 180 * np.exp(-after / 0.05)
    means = 640 - (ends[1:] - ends[:-1]) * 0.05 / 0.01
    np.testing.assert_allclose(speeds[30:], means[:, None] * np.ones(4), rtol=1e-4)


def test_a_commanded_field_is_saved_exported_and_disturbed_in_its_body(tmp_path):
    field = actuated(hj.rigid_body(IRIS, ("Ix",)), LAGGING, ("curve", "time_constants", "delay"))
    hj.save(tmp_path / "model.npz", field)
    loaded = hj.load(tmp_path / "model.npz").field
    assert named_parameters(loaded).keys() >= {"curve[1]", "time_constants[0]", "delay", "Ix"}
    assert sizes_of(loaded, None, None) == (17, 4)
    assert disturbance_of(hj.with_disturbance(field)).indices == tuple(range(7, 13))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: replace(LAGGING, curve=(1.0,)), "two to six"),
        (lambda: replace(LAGGING, gives="torque"), "speed, thrust"),
        (lambda: replace(LAGGING, voltage_exponent=1.0), "nominal_voltage"),
        (lambda: actuated(BODY, LAGGING, ("gain",)), "'gain'"),
        (lambda: actuated(BODY, LAGGING, ("curve",)), "k_rotors"),
    ],
)
def test_malformed_actuators_and_names_that_cannot_be_learned_are_refused(make, said):
    refusal(make, said)
