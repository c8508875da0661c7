"""A vehicle with turning motors is in the air only where they carry it."""

from dataclasses import replace

import numpy as np
import pytest

from hybrid_jax.flights.checks.airborne import CLEAR, MARGIN, airborne
from hybrid_jax.flights.recording import Recording, Signal

T = np.arange(0, 12, 0.01)
CARRIES, CLIMBS = 3.0, 3.5  # s when the power reaches that of flight, and when the vehicle is clear of the ground
LANDS, STOPS = 9.0, 10.0


@pytest.fixture
def hop() -> Recording:
    """Rests, turns its motors too slowly, climbs to 1 m above a table, lands there, and stops."""
    power = np.interp(T, [0, 1, 1.001, CARRIES, STOPS, STOPS + 0.001], [0, 0, 0.3, 0.7, 0.7, 0])
    z = 0.4 + np.interp(T, [CARRIES, CLIMBS, 4, 8, LANDS, 9.2], [0, CLEAR, 1, 1, CLEAR, 0])
    return Recording(
        "hop",
        {
            "command": Signal(T, np.sqrt(power)[:, None] * np.ones(4), tuple("0123"), "motors"),
            "position": Signal(T, np.stack([0 * T, 0 * T, z], axis=1), ("x", "y", "z"), "pose"),
        },
    )


def without_height(recording: Recording) -> Recording:
    return replace(recording, signals={"command": recording.signals["command"]})


def test_a_vehicle_flies_while_it_is_clear_of_where_it_stood(hop):
    np.testing.assert_allclose(airborne(hop), [(CLIMBS, LANDS)], atol=0.02)


def test_without_height_it_flies_from_the_power_that_carries_it_to_shortly_before_its_motors_stop(hop):
    np.testing.assert_allclose(airborne(without_height(hop)), [(CARRIES, STOPS - MARGIN)], atol=0.02)


def test_a_log_that_begins_and_ends_in_flight_is_all_flight(hop):
    inside = (T > 4) & (T < 8)
    part = {name: replace(each, t=each.t[inside], values=each.values[inside]) for name, each in hop.signals.items()}
    np.testing.assert_allclose(airborne(Recording("part", part)), [(4, 8)], atol=0.02)


def test_a_short_dip_of_the_power_ends_no_flight(hop):
    dipped = np.array(hop.signals["command"].values)
    dipped[(T > 6) & (T < 6.3)] = 0.05
    signals = {"command": replace(hop.signals["command"], values=dipped)}
    assert len(airborne(replace(hop, signals=signals))) == 1
