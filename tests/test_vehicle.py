"""A vehicle file is read, or refused in one line that names what is wrong."""

import math
from dataclasses import replace

import pytest

from hybrid_jax.vehicle import IRIS, load_vehicle

GOOD = {
    "mass": "1.5",
    "inertia": "[0.029, 0.03, 0.055]",
    "thrust_coefficient": "8.5e-6",
    "torque_coefficient": "1e-6",
    "rotor_positions": "[[0.1, -0.2], [-0.1, 0.2], [0.1, 0.2], [-0.1, -0.2]]",
    "spin": "[-1, -1, 1, 1]",
    "max_rotor_speed": "1100.0",
    "rotor_radius": "0.1",
    "gravity": "9.8",
    "name": '"mine"',
}


@pytest.fixture
def written(tmp_path):
    def write(**changes):
        entries = {key: value for key, value in (GOOD | changes).items() if value is not None}
        path = tmp_path / "vehicle.toml"
        path.write_text("[vehicle]\n" + "".join(f"{key} = {value}\n" for key, value in entries.items()))
        return path

    return write


def refusal(path):
    with pytest.raises(ValueError, match=r".") as error:
        load_vehicle(path)
    message = str(error.value)
    assert str(path) in message
    assert "\n" not in message
    return message.replace(str(path), "")


def test_every_constant_is_read(written):
    vehicle = load_vehicle(written())
    assert vehicle.mass == 1.5
    assert vehicle.inertia == (0.029, 0.03, 0.055)
    assert vehicle.rotor_positions[1] == (-0.1, 0.2)
    assert vehicle.spin == (-1, -1, 1, 1)
    assert (vehicle.rotor_radius, vehicle.gravity, vehicle.name) == (0.1, 9.8, "mine")
    hash(vehicle)  # it is part of what a compiled program is found by


def test_defaults(written):
    vehicle = load_vehicle(written(rotor_radius=None, gravity=None, name=None))
    assert (vehicle.rotor_radius, vehicle.gravity, vehicle.name) == (0.0, 9.81, "vehicle")


@pytest.mark.parametrize("key", [key for key in GOOD if key not in ("rotor_radius", "gravity", "name")])
def test_a_missing_key_is_named(written, key):
    assert refusal(written(**{key: None})) == f": [vehicle]: {key}: must be given"


@pytest.mark.parametrize("value", ["-1.0", "0", "nan", "inf", '"heavy"', "[1.0]", "true"])
@pytest.mark.parametrize("key", ["mass", "thrust_coefficient", "torque_coefficient", "max_rotor_speed", "gravity"])
def test_constants_must_be_positive(written, key, value):
    assert key in refusal(written(**{key: value}))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("inertia", "[0.1, 0.1]"),
        ("inertia", "[0.1, -0.1, 0.1]"),
        ("inertia", "[0.1, nan, 0.1]"),
        ("inertia", "0.1"),
        ("rotor_positions", "[[0.1, -0.2], [-0.1, 0.2], [0.1, 0.2]]"),
        ("rotor_positions", "[[0.1, -0.2], [-0.1, 0.2], [0.1, 0.2], [0.1]]"),
        ("rotor_positions", "[[0.1, -0.2], [-0.1, 0.2], [0.1, 0.2], [nan, 0.1]]"),
        ("rotor_positions", '[[0.1, -0.2], [-0.1, 0.2], [0.1, 0.2], ["a", 0.1]]'),
        ("rotor_positions", "[0.1, -0.1, 0.2, -0.2]"),
        ("spin", "[0, -1, 1, 1]"),
        ("spin", "[-1, -1, 1]"),
        ("spin", '["cw", "cw", "ccw", "ccw"]'),
        ("spin", "1"),
        ("rotor_radius", "-0.1"),
        ("rotor_radius", "nan"),
    ],
)
def test_malformed_constants_are_named(written, key, value):
    assert key in refusal(written(**{key: value}))


@pytest.fixture
def with_payload(written):
    def write(text):
        path = written()
        path.write_text(path.read_text() + f"[vehicle.payload]\n{text}\n")
        return path

    return write


def test_variant_overrides_constants(with_payload):
    path = with_payload("mass = 2.0")
    assert load_vehicle(path).mass == 1.5
    assert load_vehicle(path, "payload") == replace(load_vehicle(path), mass=2.0)


@pytest.mark.parametrize("text", ["mas = 2.0", "mass = -2.0", "[vehicle.payload.heavy]"])
def test_all_variants_are_checked(with_payload, text):
    assert "[vehicle.payload]" in refusal(with_payload(text))


def test_unknown_variant_is_refused_with_the_known_ones(with_payload):
    with pytest.raises(ValueError, match=r"no table \[vehicle.load\]; its variants are 'payload'"):
        load_vehicle(with_payload("mass = 2.0"), "load")


def test_unknown_key_is_refused_with_the_known_ones(written):
    """A misspelt optional constant would silently keep its default."""
    assert "'gravitty': must be one of mass, inertia, thrust_coefficient," in refusal(written(gravitty="1.6"))


def test_other_files_are_refused(tmp_path):
    assert "readable TOML" in refusal(tmp_path / "none.toml")
    assert "readable TOML" in refusal(tmp_path)
    path = tmp_path / "vehicle.toml"
    for content in (b"mass: 1.5", b"\xff\xfe"):
        path.write_bytes(content)
        assert "readable TOML" in refusal(path)
    for content in ("[boat]\nmass = 1.5\n", "vehicle = 3\n"):
        path.write_text(content)
        assert "[vehicle]" in refusal(path)


def test_hover_speed_carries_the_weight():
    lift = 4 * IRIS.thrust_coefficient * IRIS.hover_speed**2
    assert math.isclose(lift, IRIS.mass * IRIS.gravity, rel_tol=1e-12)
    assert 655 < IRIS.hover_speed < 657  # the paper's figure is about 656 rad/s
