"""Cleaning bridges no gaps, describes its changes, and changes known signals as described; what is flight is found."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import LOGS
from surface import refusal

from hybrid_jax.flights import Recording, Signal, cut_windows
from hybrid_jax.flights.checks.airborne import CLEAR, MARGIN, airborne
from hybrid_jax.flights.checks.cleaning import Cleaning, clean, delay, in_flight, lag_motors, resample
from hybrid_jax.flights.log import FlightLog, gaps, repeats, segments
from hybrid_jax.trajectories import check


def with_gap(log, lost=slice(400, 420)):
    return log[np.delete(np.arange(len(log)), lost)]


def with_repeat(log, at=700):
    x = log.x.copy()
    x[at] = x[at - 1]
    return FlightLog(log.t, x, log.u)


def test_segments_end_at_gaps_and_repeats(flight):
    log = with_repeat(with_gap(flight), 680)
    assert np.flatnonzero(gaps(log)).tolist() == [399]
    assert np.flatnonzero(repeats(log)).tolist() == [680]
    assert segments(log) == [slice(0, 400), slice(400, 680), slice(681, len(log))]


@pytest.mark.parametrize("stride", [20, 1, 7])
def test_windows_never_cross_a_gap(flight, stride):
    x = flight.x.copy()
    x[:, 0] = flight.t  # each state holds its time
    marked = with_repeat(with_gap(FlightLog(flight.t, x, flight.u)))
    cut = check(cut_windows([marked], 20, stride))
    times = np.concatenate([cut.x0[:, None, 0], cut.x[:, :, 0]], axis=1)
    np.testing.assert_allclose(np.diff(times, axis=1), 0.01, atol=1e-5)
    np.testing.assert_array_equal(cut.u[0], marked.u[:20].astype(np.float32))
    expected = sum((part.stop - part.start - 21) // stride + 1 for part in segments(marked))
    assert len(cut) == expected


def test_resampling_preserves_the_flight_and_bridges_gaps_on_request_only(flight):
    rng = np.random.default_rng(0)
    t = flight.t + rng.uniform(-0.002, 0.002, len(flight))
    x = np.stack([np.interp(t, flight.t, column) for column in flight.x.T], axis=1)
    log, done = resample(FlightLog(t, x, flight.u), 0.01)
    at = np.round((log.t - flight.t[0]) / 0.01).astype(int)
    np.testing.assert_allclose(np.diff(log.t), 0.01, atol=1e-12)
    np.testing.assert_allclose(log.x, flight.x[at], atol=0.02)  # linear between samples: ẍ dt² / 8
    assert "resampled 1200 samples" in done
    assert len(cut_windows([log], 50, 50)) >= 23
    log = with_gap(flight)
    kept, _ = resample(log, 0.01)
    bridged, done = resample(log, 0.01, longest_gap=0.25)
    assert (len(segments(kept)), len(segments(bridged))) == (2, 1)
    assert "0.25" in done
    np.testing.assert_allclose(kept.t, log.t, atol=1e-9)
    repeated, _ = resample(with_repeat(flight), 0.01, longest_gap=0.021)
    assert not repeats(repeated).any()
    np.testing.assert_allclose(repeated.x[700], 0.5 * (flight.x[699] + flight.x[701]), atol=1e-4)


@pytest.mark.parametrize("lost", [slice(401, 402), slice(401, 410)])
def test_coarser_resampling_loses_no_thrust_and_hides_no_gap(flight, lost):
    log, _ = resample(flight, 0.04)
    first = int(np.argmin(np.abs(flight.t - log.t[0])))
    means = flight.u[first : first + 4 * (len(log) - 1)].reshape(-1, 4, 4).mean(axis=1)
    np.testing.assert_allclose(log.u[:-1], means, rtol=1e-6)
    log, _ = resample(with_gap(flight, lost), 0.02)
    assert gaps(log).sum() == 1
    before = log.t[: np.flatnonzero(gaps(log))[0] + 1]
    assert before[-1] <= flight.t[lost.start - 1]


def test_time_on_the_ground_is_cut_but_not_a_short_fall(flight):
    u, x = flight.u.copy(), flight.x.copy()
    u[:80], u[500:530] = 3.0, 3.0  # 0.8 s, and 0.3 s without thrust
    x[:80, 2] = flight.x[:, 2].min() - 0.3
    log, done = in_flight(FlightLog(flight.t, x, u))
    np.testing.assert_array_equal(log.t, flight.t[80:])
    assert done == "80 samples on the ground cut out"
    # Motors that turn before take-off carry nothing.
    u, x = flight.u.copy(), flight.x.copy()
    u[:80], x[:200, 2] = 3.0, flight.x[:, 2].min() - 0.3  # full power from 0.8 s on, off the ground after 2 s
    log, _ = in_flight(FlightLog(flight.t, x, u))
    np.testing.assert_array_equal(log.t, flight.t[200:])
    x[:, 2] = 0.0
    refusal(lambda: in_flight(FlightLog(flight.t, x, u)), "stays on the ground")


@pytest.mark.parametrize("steps", [-3, 0, 4])
def test_a_shift_by_whole_samples_moves_rows(flight, steps):
    log, done = delay(flight, steps * 0.01)
    at = np.searchsorted(flight.t, log.t + 1e-6) - 1
    assert len(log) == len(flight) - abs(steps)
    np.testing.assert_allclose(log.u, flight.u[at - steps], rtol=1e-6)
    np.testing.assert_allclose(log.x, flight.x[at], rtol=0, atol=1e-15)
    assert f"{abs(steps)} samples cut" in done


def test_step_response_of_the_lag_is_exponential(flight):
    u = np.where(np.arange(len(flight))[:, None] < 100, 400.0, 500.0) * np.ones(4)
    log = lag_motors(FlightLog(flight.t, flight.x, u), 0.05)
    edges = 500 - 100 * np.exp(-np.arange(31) * 0.01 / 0.05)
    area = 500 * 0.01 + 0.05 * np.diff(500 - edges)  # of each interval, in closed form
    np.testing.assert_allclose(log.u[100:130, 0], area / 0.01, rtol=1e-9)
    np.testing.assert_allclose(log.u[:100], 400)


def test_impossible_cleaning_is_refused_with_log_and_option():
    for options, said in (
        ({"resample": 5.0}, f"{LOGS[0].name}: resample: no segment without gaps is as long as dt = 5.0 s"),
        ({"delay": 5.0}, f"{LOGS[0].name}: delay: no segment without gaps is longer than the lag of 5.0 s"),
        ({"resample": 0.01, "longest_gap": -0.1}, "longest_gap must be a finite number of at least 0"),
    ):
        refusal(lambda options=options: clean(LOGS[0], Cleaning(**options)), said)


T = np.arange(0, 12, 0.01)
CARRIES, CLIMBS = 3.0, 3.5  # s when the power reaches that of flight, and when the vehicle is clear of the ground
LANDS, STOPS = 9.0, 10.0


@pytest.fixture
def hop() -> Recording:
    """Rests, turns its motors too slowly, climbs to 1 m above a table, lands there, and stops."""
    power = np.interp(T, [0, 1, 1.001, CARRIES, STOPS, STOPS + 0.001], [0, 0, 0.3, 0.7, 0.7, 0])
    z = 0.4 + np.interp(T, [CARRIES, CLIMBS, 4, 8, LANDS, 9.2], [0, CLEAR, 1, 1, CLEAR, 0])
    command = Signal(T, np.sqrt(power)[:, None] * np.ones(4), tuple("0123"), "motors")
    position = Signal(T, np.stack([0 * T, 0 * T, z], axis=1), ("x", "y", "z"), "pose")
    return Recording("hop", {"command": command, "position": position})


def test_a_vehicle_flies_while_it_is_clear_of_where_it_stood_also_at_both_ends_and_in_a_dip_of_power(hop):
    """Without height it flies from the power that carries it to shortly before its motors stop."""
    np.testing.assert_allclose(airborne(hop), [(CLIMBS, LANDS)], atol=0.02)
    blind = replace(hop, signals={"command": hop.signals["command"]})
    np.testing.assert_allclose(airborne(blind), [(CARRIES, STOPS - MARGIN)], atol=0.02)
    inside = (T > 4) & (T < 8)
    part = {name: replace(each, t=each.t[inside], values=each.values[inside]) for name, each in hop.signals.items()}
    np.testing.assert_allclose(airborne(Recording("part", part)), [(4, 8)], atol=0.02)
    dipped = np.array(hop.signals["command"].values)
    dipped[(T > 6) & (T < 6.3)] = 0.05
    signals = {"command": replace(hop.signals["command"], values=dipped)}
    assert len(airborne(replace(hop, signals=signals))) == 1
