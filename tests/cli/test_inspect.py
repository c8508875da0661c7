"""A folder of logs is described, checked and drawn, and becomes a vehicle file with the numbers that the logs tell."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from recorded import DT, LOGS, write
from scipy.signal import lfilter
from surface import refusal
from writers import column_map

from experiments.real_flight.simulated import vehicle_toml
from hybrid_jax.cli.command import ChecksFailed
from hybrid_jax.cli.inspect import Options, inspected, result_of, trusted
from hybrid_jax.cli.logs import FlightOptions, read_flights
from hybrid_jax.dynamics.vehicle_file import load_vehicle_model
from hybrid_jax.flights import FlightLog, Recording, Signal
from hybrid_jax.identification.estimates import estimate, vehicle_text
from hybrid_jax.vehicle import IRIS, load_vehicle

MASS, ARM, LAG, INERTIA = 0.5, 0.12, 0.06, (2e-3, 2.4e-3)
CURVE = np.array([0.02, 0.4, 1.9])  # N
# An order that no autopilot has: rear left, front left, front right, rear right.
PLACES = ARM / np.sqrt(2) * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
SPIN = [1, -1, 1, -1]
COLUMN_MAP = column_map(
    time=("t", "s"), position=("px py pz", "m"), attitude=("qw qx qy qz", "wxyz"), velocity=("vx vy vz", "m/s"),
    body_rates=("wx wy wz", "rad/s"), motors=("u0 u1 u2 u3", "dshot"),
)  # fmt: skip


@pytest.fixture
def odd(tmp_path):
    """Flights, and a file that cannot be read, with names like mathematics, like a colour, and not in UTF-8."""
    folder = write(tmp_path / "flights", LOGS[:2])
    (folder / "chirp_run1.csv.gz").rename(folder / "cost\xa0$5_or_$^6\x1b[31m.csv.gz")
    (folder / os.fsdecode(b"broken\xff.csv")).write_text("t,px\n0,0\n")
    (folder / "notes.txt").write_text("windy")
    (tmp_path / "v.toml").write_text(vehicle_toml(IRIS))
    return folder


@pytest.fixture(scope="module")
def commanded():
    """Thirty seconds of commands around hover, and what gyro and accelerometer would say."""
    rng, dt, count = np.random.default_rng(0), 0.005, 6000
    t, slow = dt * np.arange(count), [1 - np.exp(-dt / 0.1)]
    wander = lfilter(slow, [1, slow[0] - 1], rng.normal(0, 0.7, (count, 4)), axis=0)
    # Two rotors are trimmed higher, as if the centre of mass were in front.
    command = np.clip(0.7 + np.array([-0.02, 0.02, 0.02, -0.02]) + wander, 0.2, 1)
    kept = np.exp(-dt / LAG)
    speed = lfilter([1 - kept], [1, -kept], command, axis=0, zi=kept * command[:1])[0]
    thrust = CURVE[0] + CURVE[1] * speed + CURVE[2] * speed**2
    torque = np.stack([thrust @ PLACES[:, 1], -thrust @ PLACES[:, 0], 0.02 * thrust @ SPIN], axis=1)
    omega = np.cumsum(torque / [*INERTIA, sum(INERTIA)], axis=0) * dt
    axes = ("x", "y", "z")
    force = np.stack([0 * t, 0 * t, thrust.sum(axis=1) / MASS], axis=1) + rng.normal(0, 0.05, (count, 3))
    signals = {
        "rates": Signal(t, omega + rng.normal(0, 1e-3, omega.shape), axes, "gyro"),
        "specific_force": Signal(t, force, axes, "acc"),
        "command": Signal(t, command, tuple("0123"), "motors"),
        "voltage": Signal(t, np.full((count, 1), 11.1), ("battery",), "battery"),
    }
    return Recording("flight", signals)


def test_what_a_log_tells_is_found_and_what_it_does_not_tell_is_a_placeholder(commanded, tmp_path):
    found = estimate([commanded])
    np.testing.assert_allclose(found.positions(ARM), PLACES, atol=1e-9)
    assert found.spin() == SPIN
    assert found.lag == pytest.approx(LAG, rel=0.15)  # of a grid in steps of 17 %
    (tmp_path / "v.toml").write_text(vehicle_text(found, "twin", MASS, ARM))
    vehicle = load_vehicle(tmp_path / "v.toml")
    lift = vehicle.thrust_coefficient * np.square(vehicle.max_rotor_speed * found.hover).sum()
    assert lift == pytest.approx(MASS * vehicle.gravity, rel=0.01)
    np.testing.assert_allclose(vehicle.inertia[:2], INERTIA, rtol=0.15)
    np.testing.assert_allclose(vehicle.rotor_positions, PLACES, atol=1e-4)
    text = (tmp_path / "v.toml").read_text()
    assert "nominal_voltage = 11.1" in text
    assert "PLACEHOLDER: weigh it" not in text
    assert found.curve is not None
    x, y = load_vehicle_model(tmp_path / "v.toml").terms.centre_of_mass
    assert x > 0.001 > abs(y)
    np.testing.assert_allclose(np.polynomial.polynomial.polyval(0.7, MASS * found.curve), MASS * 9.81 / 4, rtol=0.03)
    signals = {name: commanded.signals[name] for name in ("command", "voltage")}
    text = vehicle_text(estimate([Recording("flight", signals)]), "twin", None, None)
    (tmp_path / "v.toml").write_text(text)
    assert load_vehicle(tmp_path / "v.toml").mass == 1.0
    for number in ("mass", "inertia", "spin", "rotor_positions", "max_rotor_speed"):
        (line,) = [line for line in text.splitlines() if line.startswith(f"{number} =")]
        assert "PLACEHOLDER" in line


def test_a_folder_is_described_whatever_is_in_it(tmp_path, odd, called):
    _, said, _ = called("inspect", odd, "--vehicle", tmp_path / "v.toml", "--out", tmp_path)
    assert r"broken\udcff.csv: not read: row 1, field py" in said
    assert "cost\xa0$5_or_$^6\\x1b[31m.csv.gz: CSV, unknown vehicle, 0.9 s, 4 motors: ready" in said
    assert "2 of 3 logs are ready for a model" in said
    assert "notes.txt: not a supported format" in (tmp_path / "report.html").read_text()
    results = json.loads((tmp_path / "report.json").read_text())["rows"]
    assert [row["result"].split(":")[0] for row in results] == ["not read", "ready", "ready"]


def test_without_a_vehicle_a_log_is_checked_against_itself_and_ready_if_fit_takes_it(tmp_path, called):
    """Uneven samples are put on even times by every verb; two samples are no window."""
    uneven = replace(LOGS[1], t=LOGS[1].t + 0.002 * (np.arange(len(LOGS[1])) % 2))
    in_mm = replace(LOGS[3], x=LOGS[3].x * np.repeat([1000.0, 1.0], [3, 10]))
    folder = write(tmp_path / "flights", [LOGS[0], uneven, LOGS[2][:2], in_mm])
    _, said, _ = called("inspect", folder, "--out", tmp_path)
    assert "chirp_run1.csv.gz: CSV, unknown vehicle, 0.9 s, 4 motors: ready" in said
    assert "no flight: no window of 10 intervals without gaps" in said
    assert "FAILS dp/dt against v: position is in mm" in said
    assert "2 of 4 logs are ready" in said
    assert "Without --vehicle these are not checked: number of motors, largest speed; specific force" in said


def test_a_vehicle_file_rests_on_sound_logs_alone(tmp_path, capsys):
    """Of body rates in degrees inertia comes out 57 times too small; commands are checked without their scale, too."""
    (tmp_path / "map.toml").write_text(COLUMN_MAP)
    wrong = replace(LOGS[1], x=LOGS[1].x * np.repeat([1.0, 180 / np.pi], [10, 3]))
    folder = write(tmp_path / "flights", [LOGS[0], wrong])
    paths = [folder / "chirp_run1.csv.gz", folder / "chirp_run2.csv.gz"]
    options = Options(folder, columns=tmp_path / "map.toml")
    logs = inspected(paths, None, options)
    assert ["has only motor commands" in log.problem for log in logs] == [True, True]
    assert "FAILS q̇ against ω: body rates are in degrees per second" in result_of(logs[1])
    assert [kept.name for kept in trusted(logs)] == [str(paths[0])]
    assert "left out of the vehicle file, as checks failed: chirp_run2.csv.gz" in capsys.readouterr().out
    refusal(lambda: trusted(logs[1:]), "^vehicle file: no log of a flight passed its checks")


def test_motors_that_lead_the_gyro_are_borne_where_the_lag_is_known(tmp_path):
    early = [FlightLog(log.t[:-5], log.x[:-5], log.u[5:], log.name) for log in LOGS[:1]]
    options = FlightOptions()
    assert len(read_flights(write(tmp_path, early), IRIS, DT, options, lagging=True).logs) == 1
    with pytest.raises(ChecksFailed, match="lag of the gyro behind the motors"):
        read_flights(tmp_path, IRIS, DT, options)


def test_of_a_folder_with_mistakes_what_is_sound_is_used(tmp_path, odd, called, capsys):
    """A file that cannot be read is left out; a flight under two names, and of another vehicle, is refused."""
    flights = read_flights(odd, IRIS, DT, FlightOptions())
    assert [len(flights.logs), flights.still] == [2, False]
    assert any("left out: " in line for line in flights.notes)
    assert r"broken\udcff.csv: row 1, field py" in capsys.readouterr().err
    with pytest.raises(ChecksFailed) as failed:
        read_flights(odd, replace(IRIS, mass=9 * IRIS.mass), DT, FlightOptions())
    assert [line.split(": ")[1] for line in failed.value.args[:-1]] == ["specific force over thrust per mass"]
    assert "(and 1 more of the logs)" in failed.value.args[0]
    assert failed.value.args[-1].endswith("or are they of another vehicle than iris?")
    write(odd, [replace(LOGS[1], name="copy.csv")])
    _, said, _ = called("inspect", odd, "--out", tmp_path)
    assert "the same flight as chirp_run2.csv.gz; leave one of the two out" in said
    refusal(lambda: read_flights(odd, IRIS, DT, FlightOptions()), "copy.csv.gz: the same flight as chirp_run2.csv.gz")


def test_from_flights_that_hardly_move_nothing_is_learned(tmp_path, called):
    n, rng = 200, np.random.default_rng(0)
    rest, speeds = np.tile([0, 0, 1.5, 1, *[0.0] * 9], (n, 1)), np.full((n, 4), 650.0)
    noisy = [(rest + 1e-3 * rng.normal(size=rest.shape), speeds + rng.normal(size=speeds.shape)) for _ in range(2)]
    logs = [FlightLog(DT * np.arange(n), *each, name) for name, each in zip(("a.csv", "b.csv"), noisy, strict=True)]
    (tmp_path / "v.toml").write_text(vehicle_toml(replace(IRIS, thrust_coefficient=IRIS.mass * 9.81 / 4 / 650**2)))
    files = ["-o", tmp_path / "m.npz", "--vehicle", tmp_path / "v.toml", "--out", tmp_path / "out"]
    code, _, said = called("fit", write(tmp_path / "flights", logs), *files)
    assert (code, "no flight excites a parameter; fly manoeuvres" in said) == (2, True)
