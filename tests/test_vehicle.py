"""A vehicle file is read or refused in a line; all follows a vehicle of another number of rotors than four."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import surface

import hybrid_jax as hj
from hybrid_jax.control import Controller
from hybrid_jax.dynamics import RigidBody, Terms
from hybrid_jax.dynamics.vehicle_file import LAG, load_vehicle_model
from hybrid_jax.export.program import sizes_of
from hybrid_jax.flights import FlightLog, load_log
from hybrid_jax.flights.checks.consistency import OK, check_log
from hybrid_jax.flights.checks.motor_response import respond
from hybrid_jax.sim import Domain, random_flights
from hybrid_jax.vehicle import IRIS, STATE_NAMES, input_names, load_vehicle

GOOD = {"mass": "1.5", "inertia": "[0.029, 0.03, 0.055]", "thrust_coefficient": "8.5e-6", "torque_coefficient": "1e-6"}
GOOD |= {"rotor_positions": "[[0.1, -0.2], [-0.1, 0.2], [0.1, 0.2], [-0.1, -0.2]]", "spin": "[-1, -1, 1, 1]"}
GOOD |= {"max_rotor_speed": "1100.0", "rotor_radius": "0.1", "gravity": "9.8", "name": '"mine"'}


@pytest.fixture
def written(tmp_path):
    def write(above="", below="", **changes):
        entries = {key: value for key, value in (GOOD | changes).items() if value is not None}
        path = tmp_path / "vehicle.toml"
        lines = [above, "[vehicle]", *(f"{key} = {value}" for key, value in entries.items()), below]
        path.write_text("\n".join(lines))
        return path

    return write


def refusal(path, read=load_vehicle):
    return surface.refusal(lambda: read(path), path).replace(str(path), "")


def test_every_constant_is_read_or_has_its_default(written):
    vehicle = load_vehicle(written())
    assert (vehicle.mass, vehicle.inertia, vehicle.spin) == (1.5, (0.029, 0.03, 0.055), (-1, -1, 1, 1))
    assert vehicle.rotor_positions[1] == (-0.1, 0.2)
    assert (vehicle.rotor_radius, vehicle.gravity, vehicle.name) == (0.1, 9.8, "mine")
    hash(vehicle)  # it is part of what a compiled program is found by
    path = written(rotor_radius=None, gravity=None, name=None)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())  # a byte order mark is passed over
    vehicle = load_vehicle(path)
    assert (vehicle.rotor_radius, vehicle.gravity, vehicle.name) == (0.0, 9.81, "vehicle")


THREE = "[0.1, -0.2], [-0.1, 0.2], [0.1, 0.2]"
POSITIVE = ("mass", "thrust_coefficient", "torque_coefficient", "max_rotor_speed", "gravity")
MALFORMED = {key: ["-1.0", "0", "nan", "inf", '"heavy"', "[1.0]", "true"] for key in POSITIVE} | {
    "inertia": ["[0.1, 0.1]", "[0.1, -0.1, 0.1]", "[0.1, nan, 0.1]", "0.1"],
    "rotor_positions": [f"[{THREE}{fourth}]" for fourth in ("", ", [0.1]", ", [nan, 0.1]", ', ["a", 0.1]')],
    "spin": ["[0, -1, 1, 1]", "[-1, -1, 1]", '["cw", "cw", "ccw", "ccw"]', "1"],
}


@pytest.mark.parametrize("key", MALFORMED)
def test_missing_and_malformed_constants_are_named(written, key):
    for value in MALFORMED[key]:
        assert key in refusal(written(**{key: value})), value
    assert key == "gravity" or refusal(written(**{key: None})) == f": [vehicle]: {key}: must be given"


IMPOSSIBLE = {
    "mm": ({"rotor_positions": "[[100, -200], [-100, 200], [100, 200], [-100, -200]]"}, "rotor_positions must be in m"),
    "one point": ({"rotor_positions": "[[0, 0], [0, 0], [0, 0], [0, 0]]"}, "rotor_positions must not all be equal"),
    "g cm²": ({"inertia": "[2.9e5, 3.0e5, 5.5e5]"}, "inertia in kg m² (1 g cm² is 1e-7)"),
    "no body": ({"inertia": "[0.029, 0.03, 0.55]"}, "inertia must be (Ix, Iy, Iz) in kg m² of one body"),
}


@pytest.mark.parametrize(("changes", "message"), IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_what_no_vehicle_has_is_refused(written, changes, message):
    """Each passed every check of a log, and was then learned away from."""
    found = refusal(written(**changes))
    assert found.startswith(": [vehicle]: ")
    assert message in found


SMALL, LARGE = "[[9e-3, 0], [-9e-3, 0], [0, 9e-3], [0, 0]]", "[[4, -4], [-4, 4], [4, 4], [-4, -4]]"


def test_flat_large_and_small_vehicles_are_read_and_a_variant_overrides_constants_and_is_checked(written):
    flat = {"inertia": "[1.0e-2, 1.0e-2, 2.1e-2]"}  # 1.04 and 2.08 to two digits
    air_taxi = {"mass": "600", "inertia": "[1500, 1500, 2900]", "rotor_positions": LARGE}
    insect = {"mass": "0.0001", "inertia": "[1e-9, 1e-9, 2e-9]", "rotor_positions": SMALL}
    for changes in (flat, air_taxi, insect):
        assert load_vehicle(written(**changes)).rotors == 4
    path = written(below=PAYLOAD)
    assert load_vehicle(path).mass == 1.5
    assert load_vehicle(path, "payload") == replace(load_vehicle(path), mass=2.0)
    for text in ("mas = 2.0", "mass = -2.0", "[vehicle.payload.heavy]"):
        assert "[vehicle.payload]" in refusal(written(below=f"[vehicle.payload]\n{text}"))


PAYLOAD = "[vehicle.payload]\nmass = 2.0\n"


def test_what_is_unknown_is_refused_with_what_is_known_and_so_are_other_files(written, tmp_path):
    """A misspelt optional constant would silently keep its default."""
    assert "'gravitty': must be one of mass, inertia, thrust_coefficient," in refusal(written(gravitty="1.6"))
    assert ": 'vehicel': must be one of vehicle, learn," in refusal(written(below="[vehicel]\nmass = 2.0"))
    with pytest.raises(ValueError, match=r"no table \[vehicle.load\]; its variants are 'payload'"):
        load_vehicle(written(below=PAYLOAD), "load")
    path = tmp_path / "vehicle.toml"
    for content in (b"mass: 1.5", b"\xff\xfe"):
        path.write_bytes(content)
        assert "readable TOML" in refusal(path)
    for content in ("[boat]\nmass = 1.5\n", "vehicle = 3\n"):
        path.write_text(content)
        assert "[vehicle]" in refusal(path)


def test_terms_and_learned_names_are_read(written):
    terms = "[terms]\ndrag = [0.1, 0.2, 0]\nmotor_time_constant = 0.02\n"
    learned = 'learn = ["k_rotors", "drag", "motor_time_constant"]'
    found = load_vehicle_model(written(learned, PAYLOAD + terms), "payload")
    assert found.terms == Terms(drag=(0.1, 0.2, 0.0), motor_time_constant=0.02)
    physics = found.physics()
    assert isinstance(physics, RigidBody)
    assert set(physics.deviations) == {"k_rotors", "drag"}
    assert physics.vehicle.mass == 2
    assert LAG in found.learn
    hash(found)


@pytest.mark.parametrize(
    ("above", "below", "message"),
    [
        ('learn = ["weight"]', "", "learn must be names of"),
        ('learn = ["k", "k_rotors"]', "", "both k and k_rotors"), ('learn = "k"', "", "learn must be a list"),
        ("learn = [1]", "", "learn must be a list"), ("", 'learn = ["k"]', "above all tables"),
        ('lern = ["k"]', "", "'lern'"), ("", "[terms]\ndarg = [1, 2, 3]", "'darg': must be one of torque_gain,"),
        ("", "[terms]\ndrag = [1, 2]", "drag must be"),
        ("", "[terms]\nmotor_time_constant = -1", "motor_time_constant"), ("terms = 3", "", "table [terms]"),
        ("actuator = 1", "", "actuator"), ("vehicle", "", "readable TOML"),
    ],
)  # fmt: skip
def test_what_cannot_be_learned_is_refused(written, above, below, message):
    assert message in refusal(written(above, below), load_vehicle_model)


def regular(rotors):
    """The Iris with rotors at equal angles that spin in turn, and as much thrust together."""
    angles = 2 * np.pi * (np.arange(rotors) + 0.5) / rotors
    places = tuple((0.25 * float(np.cos(a)), 0.25 * float(np.sin(a))) for a in angles)
    spin, k = tuple((-1.0) ** i for i in range(rotors)), IRIS.thrust_coefficient * 4 / rotors
    return replace(IRIS, name=f"{rotors}", rotor_positions=places, spin=spin, thrust_coefficient=k)


HEXA = regular(6)


@pytest.fixture(scope="module")
def flown():
    """A second of a hexarotor, of the pilot that knows it, without drag or ground."""
    flights = random_flights(Domain("six", HEXA, forces=()), 1, 1.5, jax.random.key(0))
    states, u = (np.asarray(part[0]) for part in flights[:2])
    return FlightLog(0.01 * np.arange(len(u)), states[:-1], u, "hexa"), states


@pytest.mark.parametrize("rotors", [3, 5, 6, 8, 12])
def test_equal_rotors_at_hover_speed_carry_the_weight_and_turn_nothing_but_yaw(rotors):
    vehicle = regular(rotors)
    x = jnp.zeros(13).at[3].set(1.0)
    slope = hj.rigid_body(vehicle, ("k_rotors",))(x, jnp.full(rotors, vehicle.hover_speed))
    np.testing.assert_allclose(slope[7:12], 0, atol=1e-5)
    assert hj.rigid_body(vehicle, ("k_rotors",)).theta()["k_rotors"].shape == (rotors,)


def test_the_simulator_flies_a_hexarotor_that_the_equations_predict_and_its_logs_are_read_and_checked(flown, tmp_path):
    log, states = flown
    assert log.u.shape[1] == 6
    assert np.ptp(log.u, axis=0).min() > 1  # all six are used
    with jax.enable_x64(True):
        predicted = hj.rollout(hj.rigid_body(HEXA), states[0], log.u, 0.01)
    np.testing.assert_allclose(predicted, states[1:], atol=1e-4)
    log, _ = flown
    order = np.array([3, 4, 5, 0, 1, 2])
    header = ",".join(["t", *STATE_NAMES, *input_names(6)])
    path = tmp_path / "hexa.csv"
    np.savetxt(path, np.column_stack([log.t, log.x, log.u[:, order]]), "%.9g", ",", header=header, comments="")
    read = load_log(path)
    np.testing.assert_allclose(read.u, log.u[:, order], rtol=1e-8)
    for each, right in ((log, True), (read, False)):
        found = respond(each, HEXA)
        assert found is not None
        assert (found.order == tuple(range(6))) == right
        checks = {check.name: check for check in check_log(each, HEXA)}
        assert (checks["motor order against roll and pitch"].verdict == OK) == right
    assert "6 motors" in surface.refusal(lambda: check_log(read, IRIS))


@pytest.mark.slow
def test_controller_and_export_take_the_number_from_the_vehicle():
    controller = Controller(HEXA)
    assert controller.begin().variables.shape[1] == 6
    field = hj.rigid_body(HEXA)
    x = jnp.zeros(13).at[3].set(1.0).at[2].set(1.0)
    u, _ = controller(field, jnp.broadcast_to(x, (controller.steps, 13)), x, controller.begin())
    np.testing.assert_allclose(u, HEXA.hover_speed, rtol=1e-3)
    assert sizes_of(field, None, None) == (13, 6)
