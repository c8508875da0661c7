"""Logs of Betaflight, written here byte by byte, are read as the flight they hold."""

import gzip
import tempfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal
from writers import blackbox

import hybrid_jax as hj
from hybrid_jax.flights import read_recording, to_flight

pytest.importorskip("orangebox")


class Torque(hj.AbstractVectorField):
    gains: jax.Array

    def __call__(self, x, u):
        return self.gains @ u**2


def test_a_blackbox_log_is_the_flight_it_holds(flight, written, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", "/none")  # where a killed process would leave files
    recording = read_recording(written(blackbox(flight[:200]), "flight.bbl"))
    signals, last = recording.signals, len(recording.signals["rates"])
    assert last >= 199
    np.testing.assert_allclose(signals["rates"].values, flight.x[:last, 10:], atol=0.01)
    np.testing.assert_allclose(signals["specific_force"].values, [[0, 0, 9.81]] * last)
    np.testing.assert_allclose(signals["voltage"].values, 16.5)
    np.testing.assert_allclose(signals["command"].values, flight.u[:last] / 1999, atol=3e-4)
    np.testing.assert_allclose(signals["rotor_speed"].values, flight.u[:last], atol=1)
    model = hj.StateSpaceModel(Torque(jnp.zeros((3, 4))), ("command",), {"rates": lambda x, u: x}, (0,) * 3, (9,) * 3)
    fit = hj.fit_records(model, [recording], dt=0.01)
    assert (fit.errors["rates"] < 0.1 * signals["rates"].values.std(axis=0)).all()
    assert "damage" not in recording.facts
    assert "damage" in read_recording(written(blackbox(flight[:200], ended=False), "cut.bbl")).facts
    refusal(lambda: to_flight(recording), "no position", "identify")
    packed = written(gzip.compress(blackbox(flight[:200])), "flight.bbl.gz")
    assert len(read_recording(packed).signals["rates"]) == last


def test_events_and_armings_without_frames_are_no_damage_and_pwm_and_other_headers_are_read(flight, written):
    """Of Betaflight 4: an adjustment in flight, logging that resumes, disarming; and an end with its reason."""
    events = b"E\x0d\x05\x02" + b"E\x0d\x85abcd" + b"E\x0e\x05\x06" + b"E\x0f\x04"
    whole = blackbox(flight[:200], events=events)
    empty = whole[: whole.index(b"motor_poles:14\n") + 15] + b"E\xffEnd of log\0"
    recording = read_recording(written(empty + whole + empty, "flight.bbl"))
    assert "damage" not in recording.facts
    assert len(recording.signals["rates"]) >= 199
    assert any("2 times the vehicle was armed" in note for note in recording.notes)
    two = read_recording(written(blackbox(flight[:90]) + whole, "two.bbl"))
    assert any("contains 2 flights: the longest is read" in note for note in two.notes)
    assert len(two.signals["rates"]) >= 199
    reasoned = blackbox(flight[:200], events=b"E\xffEnd of log (disarm reason:4)\0", ended=False)
    assert "damage" not in read_recording(written(reasoned, "reasoned.bbl")).facts
    headers = ["vbatcellvoltage:unknown", "motor_poles:12", "blackbox_high_resolution:1"]
    signals = read_recording(written(blackbox(flight[:200], headers=headers, digital=False), "flight.bbl")).signals
    last = len(signals["command"])
    np.testing.assert_allclose(signals["command"].values, flight.u[:last] / 1000, atol=6e-4)
    np.testing.assert_allclose(signals["rotor_speed"].values, flight.u[:last] * 14 / 12, atol=1)
    np.testing.assert_allclose(signals["rates"].values, flight.x[:last, 10:] / 10, atol=1e-3)
    refusal(lambda: read_recording(written(blackbox(flight[:20], headers=["acc_1G:big"]), "a.bbl")), "header acc_1G")
