"""Vehicles of other numbers of rotors than four: physics, simulator, logs, control and export follow the vehicle."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.control import Controller
from hybrid_jax.export.program import sizes_of
from hybrid_jax.flights import FlightLog, load_log
from hybrid_jax.flights.checks.consistency import OK, check_log
from hybrid_jax.flights.checks.motor_response import respond
from hybrid_jax.sim import Domain, random_flights
from hybrid_jax.vehicle import IRIS, STATE_NAMES, input_names


def regular(rotors):
    """The Iris with rotors at equal angles that spin in turn, and as much thrust together."""
    angles = 2 * np.pi * (np.arange(rotors) + 0.5) / rotors
    places = tuple((0.25 * float(np.cos(a)), 0.25 * float(np.sin(a))) for a in angles)
    spin, k = tuple((-1.0) ** i for i in range(rotors)), IRIS.thrust_coefficient * 4 / rotors
    return replace(IRIS, name=f"{rotors}", rotor_positions=places, spin=spin, thrust_coefficient=k)


HEXA = regular(6)


@pytest.fixture(scope="module")
def flown():
    """A second of a hexarotor, of the pilot that knows it, without drag or ground."""
    flights = random_flights(Domain("six", HEXA, forces=()), 1, 1.5, jax.random.key(0))
    states, u = (np.asarray(part[0]) for part in flights[:2])
    return FlightLog(0.01 * np.arange(len(u)), states[:-1], u, "hexa"), states


@pytest.mark.parametrize("rotors", [3, 5, 6, 8, 12])
def test_equal_rotors_at_hover_speed_carry_the_weight_and_turn_nothing_but_yaw(rotors):
    vehicle = regular(rotors)
    x = jnp.zeros(13).at[3].set(1.0)
    slope = hj.rigid_body(vehicle, ("k_rotors",))(x, jnp.full(rotors, vehicle.hover_speed))
    np.testing.assert_allclose(slope[7:12], 0, atol=1e-5)
    assert hj.rigid_body(vehicle, ("k_rotors",)).theta()["k_rotors"].shape == (rotors,)


def test_the_simulator_flies_a_hexarotor_that_the_equations_predict(flown):
    log, states = flown
    assert log.u.shape[1] == 6
    assert np.ptp(log.u, axis=0).min() > 1  # all six are used
    with jax.enable_x64(True):
        predicted = hj.rollout(hj.rigid_body(HEXA), states[0], log.u, 0.01)
    np.testing.assert_allclose(predicted, states[1:], atol=1e-4)


def test_logs_of_six_rotors_are_read_and_motors_in_another_order_found(flown, tmp_path):
    log, _ = flown
    order = np.array([3, 4, 5, 0, 1, 2])
    header = ",".join(["t", *STATE_NAMES, *input_names(6)])
    path = tmp_path / "hexa.csv"
    np.savetxt(path, np.column_stack([log.t, log.x, log.u[:, order]]), "%.9g", ",", header=header, comments="")
    read = load_log(path)
    np.testing.assert_allclose(read.u, log.u[:, order], rtol=1e-8)
    for each, right in ((log, True), (read, False)):
        found = respond(each, HEXA)
        assert found is not None
        assert (found.order == tuple(range(6))) == right
        checks = {check.name: check for check in check_log(each, HEXA)}
        assert (checks["motor order against roll and pitch"].verdict == OK) == right
    assert "6 motors" in refusal(lambda: check_log(read, IRIS))


@pytest.mark.slow
def test_controller_and_export_take_the_number_from_the_vehicle():
    controller = Controller(HEXA)
    assert controller.begin().variables.shape[1] == 6
    field = hj.rigid_body(HEXA)
    x = jnp.zeros(13).at[3].set(1.0).at[2].set(1.0)
    u, _ = controller(field, jnp.broadcast_to(x, (controller.steps, 13)), x, controller.begin())
    np.testing.assert_allclose(u, HEXA.hover_speed, rtol=1e-3)
    assert sizes_of(field, None, None) == (13, 6)
