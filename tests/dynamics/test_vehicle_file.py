"""A vehicle file says what may be learned, or is refused in one line that says what is wrong."""

import pytest

from hybrid_jax import rigid_body
from hybrid_jax.dynamics.multirotor import Multirotor
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.dynamics.vehicle_file import VehicleDescription, load_description
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


def test_a_vehicle_alone_is_the_paper_s_rigid_body(written):
    path = written()
    found = load_description(path)
    assert found == VehicleDescription(load_vehicle(path))
    assert set(found.physics().deviations) == set(rigid_body(found.vehicle).log_ratios)
    assert not found.learns_motor_lag


def test_what_is_learned_and_known_is_read(written):
    path = written(
        'learn = ["k_rotors", "drag", "motor_time_constant"]',
        "[vehicle.payload]\nmass = 2\n[terms]\ndrag = [0.1, 0.2, 0]\nmotor_time_constant = 0.02\n",
    )
    found = load_description(path, "payload")
    assert found.terms == Terms(drag=(0.1, 0.2, 0.0), motor_time_constant=0.02)
    physics = found.physics()
    assert isinstance(physics, Multirotor)
    assert set(physics.deviations) == {"k_rotors", "drag"}
    assert physics.vehicle.mass == 2
    assert found.learns_motor_lag
    hash(found)


@pytest.mark.parametrize(
    ("above", "below", "said"),
    [
        ('learn = ["mass"]', "", "learn must be names of"),
        ('learn = ["k", "k"]', "", "learn"),
        ('learn = ["k", "k_rotors"]', "", "both k and k_rotors"),
        ('learn = "k"', "", "learn must be a list"),
        ("learn = [1]", "", "learn must be a list"),
        ("[learn]\nk = true", "", "learn must be a list"),
        ("", 'learn = ["k"]', "above all tables"),
        ('lern = ["k"]', "", "'lern'"),
        ("", "[terms]\ndarg = [1, 2, 3]", "'darg'"),
        ("", "[terms]\ndrag = [1, 2]", "drag must be"),
        ("", "[terms]\nmotor_time_constant = -1", "motor_time_constant"),
        ("terms = 3", "", "table [terms]"),
        ("vehicle", "", "readable TOML"),
    ],
)
def test_a_file_that_makes_no_sense_is_refused_in_one_line(written, above, below, said):
    path = written(above + "\n", below)
    with pytest.raises(ValueError, match=r".") as error:
        load_description(path)
    message = str(error.value)
    assert message.startswith(str(path))
    assert said in message
    assert "\n" not in message
