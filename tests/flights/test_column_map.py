"""A log in other names, units, orders and frames becomes the same flight as in the library's own."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from surface import outcome, refusal

from hybrid_jax.flights.attitude import BODIES, WORLDS
from hybrid_jax.flights.formats.column_map import load_column_map
from hybrid_jax.flights.load import load_log

GOOD = """
frames = {world = "NED", body = "FRD", velocity = "body"}
time = {columns = ["stamp"], unit = "us"}
position = {columns = ["x", "y", "z"], unit = "mm"}
attitude = {columns = ["q1", "q2", "q3", "q4"], unit = "xyzw"}
velocity = {columns = ["u", "v", "w"], unit = "cm/s"}
body_rates = {columns = ["p", "q", "r"], unit = "deg/s"}
motors = {columns = ["m3", "m1", "m4", "m2"], unit = "rpm"}
[format]
delimiter = ";"
"""
EULER = [('["q1", "q2", "q3", "q4"]', '["roll", "pitch", "yaw"]'), ('"xyzw"', '"deg"')]
AFFINE = [('"rpm"', '"command", polynomial = [100.0, 1000.0]')]
QUADRATIC = [('"rpm"', '"command", polynomial = [50, 200.0, 800.0]')]


def foreign(flight):
    """The flight as a logger in NED, FRD and the units of GOOD writes it, by name of column."""
    world, body = WORLDS["NED"], BODIES["FRD"]
    to_world = Rotation.from_quat(np.roll(flight.x[:, 3:7], -1, axis=1))
    attitude = Rotation.from_matrix(world.T @ to_world.as_matrix() @ body)
    u = flight.u
    command = (u - 100) / 1000
    squared = (-200 + np.sqrt(200**2 + 4 * 800 * (u - 50))) / 1600
    yaw, pitch, roll = attitude.as_euler("ZYX", degrees=True).T
    columns = {"stamp": flight.t * 1e6 + 7e9, "roll": roll, "pitch": pitch, "yaw": yaw}
    columns |= dict(zip("xyz", 1000 * world.T @ flight.x[:, :3].T, strict=True))
    columns |= dict(zip(("q1", "q2", "q3", "q4"), attitude.as_quat().T, strict=True))
    columns |= dict(zip("uvw", 100 * body @ to_world.inv().apply(flight.x[:, 7:10]).T, strict=True))
    columns |= dict(zip("pqr", np.rad2deg(body @ flight.x[:, 10:].T), strict=True))
    for name, motors in (("rpm", u * 30 / np.pi), ("affine", command), ("quadratic", squared)):
        columns |= dict(zip((f"{name}_{m}" for m in ("m3", "m1", "m4", "m2")), motors.T, strict=True))
    return columns


@pytest.fixture
def mapped(tmp_path):
    def read(columns, changes=(), motors="rpm"):
        text = GOOD
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "map.toml").write_text(text)
        names = [name.removeprefix(f"{motors}_") for name in columns]
        rows = [";".join(map(repr, row)) for row in np.column_stack(list(columns.values())).tolist()]
        (tmp_path / "log.csv").write_text("\n".join([";".join(names), *rows]))
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
        ([('unit = "mm"', "unit = 3")], ("[position]", "unit")),
        ([(', unit = "mm"', "")], ("[position]", "unit: must be given")),
        ([('["u", "v", "w"]', '["u", "v"]')], ("[velocity]", "3 names")),
        ([('["u", "v", "w"]', '"uvw"')], ("[velocity]", "list of 3")),
        ([('["u", "v", "w"]', '["u", "v", "u"]')], ("'u' is named twice",)),
        ([("position =", "place =")], ("'place'", "must be one of frames, time")),
        ([('unit = "deg/s"', 'unit = "deg/s", sign = 1')], ("[body_rates]", "'sign'", "must be one of")),
        ([('"rpm"', '"command"')], ("[motors]", "polynomial")),
        ([('"rpm"', '"rpm", polynomial = [1.0]')], ("[motors]", "polynomial")),
        ([('delimiter = ";"', 'delimiter = ";;"')], ("[format]", "delimiter")),
        ([("[format]", "[format")], ("not a readable TOML",)),
        ([("[format]", "x = " + "[" * 2000 + "\n[format]")], ("not a readable TOML",)),
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
@given(st.text(max_size=80), st.integers(0, len(GOOD)))
def test_any_map_is_read_or_refused(tmp_path_factory, text, at):
    path = tmp_path_factory.getbasetemp() / "fuzzed.toml"
    path.write_bytes((GOOD[:at] + text + GOOD[at:]).encode("utf-8", "replace"))
    outcome(load_column_map, path, naming=str(path))
