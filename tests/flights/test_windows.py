"""A log is whole and possible; a folder becomes windows; held-out flights are disjoint; scores are as defined."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recorded import DT, LOGS, SAMPLES, write
from surface import refusal
from systems import columns, flying, infer_batch, one_by_one, train_batch

import hybrid_jax as hj
from hybrid_jax import Trajectories, rigid_body, rotation
from hybrid_jax.dynamics import FrozenRates, HoldState
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.windows import errors_between, flight_errors, flight_of, folds, hold_out, manoeuvre_of
from hybrid_jax.vehicle import BODY_RATES, IRIS, POSITION, QUATERNION, VELOCITY


def test_windows_are_those_of_all_logs(tmp_path, recwarn):
    write(tmp_path, LOGS[:2])
    windows = hj.load_windows(tmp_path, IRIS, steps=20, stride=5)
    assert (windows.dt, windows.horizon, len(windows)) == (DT, 20, 2 * len(range(0, SAMPLES - 20, 5)))
    assert windows.x.dtype == np.float32
    np.testing.assert_allclose(windows.x[0], LOGS[0].x[1:21], atol=1e-5)
    assert all("\n" not in str(each.message) for each in recwarn)


@pytest.mark.filterwarnings("ignore")
def test_logs_are_resampled_to_dt_and_rotors_may_lag(tmp_path):
    write(tmp_path, [LOGS[0], replace(LOGS[1], t=2 * LOGS[1].t)])
    refusal(lambda: hj.load_windows(tmp_path, IRIS, failed="warn"), "0.02 s apart", "dt=0.02")
    windows = hj.load_windows(tmp_path, IRIS, dt=0.02, motor_time_constant=0.05, failed="warn")
    assert windows.dt == 0.02
    assert windows.u.std() < hj.load_windows(tmp_path, IRIS, dt=0.02, failed="warn").u.std()


def test_failed_checks_are_reported_and_invalid_arguments_refused(tmp_path):
    still = FlightLog(LOGS[0].t, LOGS[0].x, LOGS[0].u * [1, 1, 1, 0], "still.csv")
    write(tmp_path, [still])
    with pytest.warns(UserWarning, match=r"still.csv.gz: columns: u3 never changes"):
        hj.load_windows(tmp_path, IRIS, failed="warn")
    refusal(lambda: hj.load_windows(tmp_path, IRIS), "still.csv.gz: ", 'to continue anyway, use failed="warn"')
    refusal(lambda: hj.load_windows(tmp_path, IRIS, failed="no"), "failed must be")
    sound = write(tmp_path / "sound", LOGS[:1])
    refusal(lambda: hj.load_windows(sound, IRIS, steps=0), "steps")
    refusal(lambda: hj.load_windows(sound, IRIS, dt=-1.0), "dt must be")
    refusal(lambda: hj.load_windows(sound, IRIS, steps=500), "no window of 500")
    refusal(lambda: hj.load_windows(tmp_path / "none", IRIS), "no such folder")


def test_quaternions_become_unit_and_continuous_and_the_arrays_given_are_not_changed(flight):
    signs = np.where(np.arange(len(flight)) % 3 == 1, -1.01, 0.99)[:, None]
    x = np.concatenate([flight.x[:, :3], flight.x[:, 3:7] * signs, flight.x[:, 7:]], axis=1)
    before = x.copy()
    again = FlightLog(flight.t, x, flight.u)
    np.testing.assert_allclose(again.x, flight.x, atol=1e-12)
    assert again.x[0, 3] >= 0
    np.testing.assert_array_equal(x, before)
    refusal(lambda: FlightLog(flight.t[1:], flight.x, flight.u), "(n, 13)")
    refusal(lambda: FlightLog(flight.t[:0], flight.x[:0], flight.u[:0]), "no samples")


@pytest.mark.parametrize(
    ("array", "at", "value", "words"),
    [
        ("t", 5, np.nan, ("sample 5", "field t", "nan")), ("t", 5, 0.0, ("sample 5", "field t", "goes back")),
        ("t", 6, 0.05, ("sample 6", "repeats")), ("x", (7, 8), np.inf, ("sample 7", "field vy", "inf")),
        ("u", (3, 2), np.nan, ("sample 3", "field u2")), ("u", (3, 2), -1.0, ("sample 3", "field u2", "negative")),
        ("x", (9, slice(3, 7)), 0.0, ("sample 9", "qw", "norm is 0")),
        ("x", (9, 3), 1e200, ("sample 9", "qw", "is 1e+200")), ("x", (9, 0), 2e9, ("sample 9", "px", "is 2e+09")),
    ],
)  # fmt: skip
def test_impossible_values_are_named(flight, array, at, value, words):
    broken = {"t": flight.t.copy(), "x": flight.x.copy(), "u": flight.u.copy()}
    broken[array][at] = value
    refusal(lambda: FlightLog(**broken, name="mine"), "mine", *words)


@pytest.mark.parametrize(
    ("name", "own", "manoeuvre"),
    [
        ("/a/b/chirp_run2.csv.gz", "chirp_run2", "chirp"), ("melon-03.csv", "melon-03", "melon"),
        ("flight_17.csv", "flight_17", "flight_17"), ("figure8_run2.ULG", "figure8_run2", "figure8"),
        ("squarerun3.csv", "squarerun3", "square"), ("hover flight-4.csv", "hover flight-4", "hover"),
        ("2024.05.01_hover_2.Csv.Gz", "2024.05.01_hover_2", "2024.05.01_hover"), ("17.csv", "17", "17"),
    ],
)  # fmt: skip
def test_names_of_flights_and_manoeuvres(name, own, manoeuvre):
    log = replace(LOGS[0], name=name)
    assert (flight_of(log), manoeuvre_of(log)) == (own, manoeuvre)


@pytest.mark.parametrize("of", [flight_of, manoeuvre_of])
@pytest.mark.parametrize("count", [None, 2])
def test_folds_hold_out_every_flight_once(of, count):
    found = folds(LOGS, count, of)
    assert len(found) == (count or len({of(log) for log in LOGS}))
    held = [log.name for _, out in found for log in out]
    assert sorted(held) == sorted(log.name for log in LOGS)
    for kept, out in found:
        assert not {of(log) for log in kept} & {of(log) for log in out}
        assert len(kept) + len(out) == len(LOGS)


def test_a_manoeuvre_is_held_out_whole_if_it_is_one():
    kept, out = hold_out(LOGS, ["random"], manoeuvre_of)
    assert [flight_of(log) for log in out] == ["random_run1", "random_run2", "random_run3"]
    assert len(kept) == 6
    refusal(lambda: hold_out(LOGS, ["melon"], manoeuvre_of), "'melon'", "chirp")
    refusal(lambda: hold_out(LOGS[:1], ["chirp_run1"]), "0 flights for training")
    refusal(lambda: folds(LOGS, 4, manoeuvre_of), "3 different names")


def flights(count=7, steps=4):
    u = np.random.default_rng(1).uniform(600, 700, (count, steps, 4)).astype(np.float32)
    x0 = flying(count)[0].astype(np.float32)
    return Trajectories(x0, u, np.asarray(jax.jit(hj.rollout_batch)(rigid_body(IRIS), x0, u, 0.01)), 0.01)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.3, 3.0])
def test_errors_are_lengths_and_an_angle(angle):
    x = flying(5)[0].astype(np.float32)
    turn = rotation.from_axis_angle(jnp.array([0.6, 0.0, 0.8]), jnp.asarray(angle))
    q = jax.vmap(lambda q: -rotation.multiply(q, turn))(x[:, QUATERNION])  # −q is the same rotation
    other = jnp.asarray(x).at[:, QUATERNION].set(q)
    for part, offset in ((POSITION, [3, 4, 0]), (VELOCITY, [0, 0, -2]), (BODY_RATES, [1, 2, 2])):
        other = other.at[:, part].add(jnp.array(offset, float))
    expected = (5, 2, angle, 3)
    for found, value in zip(errors_between(other, jnp.asarray(x)), expected, strict=True):
        np.testing.assert_allclose(found, value, rtol=1e-3, atol=1e-6)  # float32; an arc cosine would err by 3e-4


def test_exact_physics_has_no_error_baselines_hold_the_state_or_freeze_rates_and_chunks_do_not_matter(monkeypatch):
    windows = flights()
    for error in flight_errors(rigid_body(IRIS), windows):
        assert error.shape == (7, 4)
        assert (error < 1e-5).all()
    whole = flight_errors(HoldState(), windows)
    monkeypatch.setattr("hybrid_jax.flights.windows.CHUNK", 3)
    np.testing.assert_allclose(np.stack(whole), np.stack(flight_errors(HoldState(), windows)), rtol=1e-6)
    other = Trajectories(np.zeros((2, 2)), np.zeros((2, 3, 1)), np.zeros((2, 3, 2)), 0.1)
    refusal(lambda: flight_errors(HoldState(), other), "states of 13")
    x, u = columns(5)
    plain = rigid_body(IRIS)
    for evaluate in (train_batch, infer_batch, one_by_one):
        assert (evaluate(HoldState(), x, u) == 0).all()
        frozen, whole = evaluate(FrozenRates(plain), x, u), evaluate(plain, x, u)
        assert (frozen[BODY_RATES] == 0).all()
        np.testing.assert_allclose(frozen[:10], whole[:10], rtol=1e-6, atol=1e-6)
    windows = flights()
    np.testing.assert_array_equal(hj.rollout_batch(HoldState(), windows.x0, windows.u, 0.01)[:, -1], windows.x0)
