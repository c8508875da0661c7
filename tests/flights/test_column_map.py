"""A log in other names, units, orders and frames becomes the same flight as in the library's own."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surface import outcome, refusal
from writers import MAP, foreign, table_of

from hybrid_jax.flights.formats.column_map import load_column_map
from hybrid_jax.flights.load import load_log

EULER = [('["q1", "q2", "q3", "q4"]', '["roll", "pitch", "yaw"]'), ('"xyzw"', '"deg"')]
AFFINE = [('"rpm"', '"command", polynomial = [100.0, 1000.0]')]
QUADRATIC = [('"rpm"', '"command", polynomial = [50, 200.0, 800.0]')]


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


@pytest.mark.parametrize(
    ("changes", "motors"), [((), "rpm"), (EULER, "rpm"), (AFFINE, "affine"), (QUADRATIC, "quadratic")]
)
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
