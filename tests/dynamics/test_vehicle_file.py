"""A whole vehicle file is read, or refused in one line that names what is wrong."""

import pytest

from hybrid_jax import rigid_body
from hybrid_jax.dynamics.multirotor import Multirotor
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.dynamics.vehicle_file import LAG, VehicleModel, load_vehicle_model
from hybrid_jax.vehicle import load_vehicle

VEHICLE = """
[vehicle]
mass = 1.5
inertia = [0.029, 0.03, 0.055]
thrust_coefficient = 8.5e-6
torque_coefficient = 1e-6
rotor_positions = [[0.1, -0.2], [-0.1, 0.2], [0.1, 0.2], [-0.1, -0.2]]
spin = [-1, -1, 1, 1]
max_rotor_speed = 1100.0
"""


@pytest.fixture
def written(tmp_path):
    def write(above="", below=""):
        path = tmp_path / "vehicle.toml"
        path.write_text(above + VEHICLE + below)
        return path

    return write


def test_vehicle_without_terms_is_the_rigid_body_of_the_paper(written):
    path = written()
    found = load_vehicle_model(path)
    assert found == VehicleModel(load_vehicle(path))
    assert set(found.physics().deviations) == set(rigid_body(found.vehicle).log_ratios)


def test_terms_and_learned_names_are_read(written):
    path = written(
        'learn = ["k_rotors", "drag", "motor_time_constant"]',
        "[vehicle.payload]\nmass = 2\n[terms]\ndrag = [0.1, 0.2, 0]\nmotor_time_constant = 0.02\n",
    )
    found = load_vehicle_model(path, "payload")
    assert found.terms == Terms(drag=(0.1, 0.2, 0.0), motor_time_constant=0.02)
    physics = found.physics()
    assert isinstance(physics, Multirotor)
    assert set(physics.deviations) == {"k_rotors", "drag"}
    assert physics.vehicle.mass == 2
    assert LAG in found.learn
    hash(found)


@pytest.mark.parametrize(
    ("above", "below", "message"),
    [
        ('learn = ["mass"]', "", "learn must be names of"),
        ('learn = ["k", "k"]', "", "learn"),
        ('learn = ["k", "k_rotors"]', "", "both k and k_rotors"),
        ('learn = "k"', "", "learn must be a list"),
        ("learn = [1]", "", "learn must be a list"),
        ("[learn]\nk = true", "", "learn must be a list"),
        ("", 'learn = ["k"]', "above all tables"),
        ('lern = ["k"]', "", "'lern'"),
        ("", "[terms]\ndarg = [1, 2, 3]", "'darg': must be one of torque_gain,"),
        ("", "[terms]\ndrag = [1, 2]", "drag must be"),
        ("", "[terms]\nmotor_time_constant = -1", "motor_time_constant"),
        ("terms = 3", "", "table [terms]"),
        ("vehicle", "", "readable TOML"),
    ],
)
def test_invalid_files_are_refused_in_one_line(written, above, below, message):
    path = written(above + "\n", below)
    with pytest.raises(ValueError, match=r".") as error:
        load_vehicle_model(path)
    text = str(error.value)
    assert text.startswith(str(path))
    assert message in text
    assert "\n" not in text
