"""A log in other names, units, orders and frames, or with lines between slow samples, is the same flight."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surface import outcome, refusal
from writers import MAP, foreign, table_of

from hybrid_jax.flights import attitude, load_log
from hybrid_jax.flights.attitude import from_euler, rotation_of
from hybrid_jax.flights.formats import raw
from hybrid_jax.flights.formats.column_map import load_column_map
from hybrid_jax.flights.formats.raw import Samples, own_samples, record

EULER = [('["q1", "q2", "q3", "q4"]', '["roll", "pitch", "yaw"]'), ('"xyzw"', '"deg"')]
AFFINE = [('"rpm"', '"command", polynomial = [100.0, 1000.0]')]
CURVE = [('"rpm"', '"command", polynomial = [50, 200.0, 800.0]')]


@pytest.fixture
def mapped(tmp_path):
    def read(columns, changes=(), motors="rpm"):
        text = MAP
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "map.toml").write_text(text)
        (tmp_path / "log.csv").write_text(table_of(columns, motors))
        return load_log(tmp_path / "log.csv", columns=tmp_path / "map.toml")

    return read


@pytest.mark.parametrize(("changes", "motors"), [((), "rpm"), (EULER, "rpm"), (AFFINE, "affine"), (CURVE, "quadratic")])
def test_mapped_log_is_the_same_flight(flight, mapped, changes, motors):
    log = mapped(foreign(flight), changes, motors)
    np.testing.assert_allclose(log.t - log.t[0], flight.t - flight.t[0], atol=1e-9)
    np.testing.assert_allclose(log.x, flight.x, atol=1e-9)
    np.testing.assert_allclose(log.u, flight.u, rtol=1e-9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ([('world = "NED"', 'world = "SED"')], ("world must be one of ENU, NED", "'SED'")),
        ([('world = "NED", ', "")], ("[frames]", "world: must be given")),
        ([('unit = "mm"', 'unit = "ft"')], ("[position]", "m, cm, mm", "'ft'")),
        ([(', unit = "mm"', "")], ("[position]", "unit: must be given")),
        ([('["u", "v", "w"]', '["u", "v"]')], ("[velocity]", "3 names")),
        ([('["u", "v", "w"]', '["u", "v", "u"]')], ("'u' is named twice",)),
        ([("position =", "place =")], ("'place'", "must be one of frames, time")),
        ([('unit = "deg/s"', 'unit = "deg/s", sign = 1')], ("[body_rates]", "'sign'", "must be one of")),
        ([('"rpm"', '"command"')], ("[motors]", "polynomial")),
        ([('delimiter = ";"', 'delimiter = ";;"')], ("[format]", "delimiter")),
        ([("[format]", "[format")], ("not a readable TOML",)),
    ],
)
def test_a_wrong_map_is_refused(flight, mapped, tmp_path, changes, words):
    refusal(lambda: mapped(foreign(flight[:3]), changes), tmp_path / "map.toml", *words)


def test_wrong_data_are_refused_with_names_of_the_file(flight, mapped):
    columns = foreign(flight)
    refusal(lambda: mapped(columns, [*EULER[:1], ('"xyzw"', '"rad"')]), "log.csv", "roll pitch yaw", "degrees")
    refusal(lambda: mapped(columns, [('"p", ', '"pp", ')]), "log.csv", "field pp", "column map")
    half = np.where(np.arange(len(flight)) % 2 == 0, np.nan, columns["q4"])
    refusal(lambda: mapped(columns | {"q4": 2 * columns["q4"]}), "log.csv", "q1 q2 q3 q4", "has norm")
    assert mapped(columns | {"q4": half}).dt == pytest.approx(0.01)  # the other half is read, and interpolated


@settings(max_examples=100, deadline=None)
@given(st.text(max_size=80), st.integers(0, len(MAP)))
def test_any_map_is_read_or_refused(tmp_path_factory, text, at):
    path = tmp_path_factory.getbasetemp() / "fuzzed.toml"
    path.write_bytes((MAP[:at] + text + MAP[at:]).encode("utf-8", "replace"))
    outcome(load_column_map, path, naming=str(path))


def drawn(t, own, values):
    return np.stack([np.interp(t, own, column) for column in values.T], axis=1)


@pytest.mark.parametrize("beside", [0.0, 0.004])
def test_lines_become_the_samples_at_their_bends(beside):
    rng, t = np.random.default_rng(0), 0.01 * np.arange(501)
    own = np.append(0.1 * np.arange(50) + beside * (np.arange(50) % 3 == 1), 5.0)
    values = rng.normal(size=(51, 4))
    values[30:33] = values[29] + np.arange(1, 4)[:, None] * 0.5  # a line over three intervals
    found, rows = own_samples(t, drawn(t, own, values))
    assert len(found) == len(own)
    np.testing.assert_allclose(np.delete(found, [30, 31, 32]), np.delete(own, [30, 31, 32]), atol=1e-6)
    np.testing.assert_allclose(rows, drawn(found, own, values), atol=1e-5)
    own = np.delete(0.1 * np.arange(51), np.arange(20, 29))  # a line over a gap is no measurement
    found, _ = own_samples(t, drawn(t, own, np.random.default_rng(3).normal(size=(42, 4))))
    np.testing.assert_allclose(found, own, atol=1e-6)


def test_noise_steps_and_rest_stay_as_they_are_and_a_recording_says_which_signals_were_lines():
    rng, t = np.random.default_rng(1), 0.01 * np.arange(500)
    noise = rng.normal(size=(500, 3))
    smooth = np.sin(3 * t)[:, None]
    for values in (noise, smooth, np.round(smooth, 2), 0 * noise, np.where(t[:, None] > 2, noise, 0.0), noise * np.nan):
        assert own_samples(t, values)[1] is values
    rng, t = np.random.default_rng(2), 0.01 * np.arange(501)
    slow = drawn(t, 0.1 * np.arange(51), rng.normal(size=(51, 4)))
    parts = {"command": Samples(t, slow, "motors"), "rates": Samples(t, rng.normal(size=(501, 3)), "gyro")}
    found = record("log", parts)
    assert (len(found.signals["command"]), len(found.signals["rates"])) == (51, 501)
    (note,) = found.notes
    assert note.startswith("motors: values repeated, or lines between samples 0.1 s apart")


@pytest.mark.parametrize("rows", [[2], [3], [3, 3, 4], [10]], ids=str)
def test_values_that_were_repeated_are_samples_once(rows):
    """Forward-filled, as by pandas; while it rests, a value counts as often as when it changes."""
    counts = np.resize(rows, 60)
    values = np.repeat(np.random.default_rng(1).normal(size=(60, 3)), counts, axis=0)
    values = np.concatenate([values, np.repeat(values[-1:], 200, axis=0)])
    t = 0.01 * np.arange(len(values))
    own, _ = own_samples(t, values)
    np.testing.assert_allclose(own[:60], t[np.cumsum([0, *counts[:-1]])])
    assert np.median(np.diff(own)) == pytest.approx(0.01 * rows[0], abs=0.011)
    assert np.diff(own).max() < 0.01 * (max(rows) + 1.5)
    assert own_samples(t, values, repeated=False)[1] is values


def to_library(p=(0, 0, 0), q=(1, 0, 0, 0), v=(0, 0, 0), omega=(0, 0, 0)):
    """One sample in NED and FRD, by the conversion of readers, whose recordings become flights."""
    parts = {"position": p, "attitude": q, "velocity": v, "rates": omega}
    samples = {name: raw.Samples(np.zeros(1), np.array([each], float), name) for name, each in parts.items()}
    return [part.values[0] for part in raw.turned(samples, "NED", "FRD").values()]


def test_level_and_north_in_ned_is_so_in_enu_and_rates_between_are_the_rates_of_the_flight(flight):
    p, q, v, omega = to_library(p=(1, 2, -3), v=(4, 5, -6), omega=(0.1, 0.2, 0.3))
    np.testing.assert_allclose(p, [2, 1, 3])  # east, north, up
    np.testing.assert_allclose(v, [5, 4, 6])
    np.testing.assert_allclose(omega, [0.1, -0.2, -0.3])
    axes = rotation_of(q[None]).as_matrix()[0].T  # where the body's forward, left and up point in the world
    np.testing.assert_allclose(axes, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12)  # nose north, left west
    _, q, *_ = to_library(q=from_euler(np.array([[0, 0, np.pi / 2]]))[0])  # yaw to the east is the identity
    np.testing.assert_allclose(np.abs(q), [1, 0, 0, 0], atol=1e-12)
    middle = 0.5 * (flight.x[1:, 10:] + flight.x[:-1, 10:])
    # Second order in the interval: ω̈ dt² / 12 with ω̈ up to some hundred rad/s³.
    np.testing.assert_allclose(attitude.rates_between(flight.t, flight.x[:, 3:7]), middle, atol=5e-3)
