"""Laws of the recorded flights, and what the simulator says of its versions and pictures."""

from collections import Counter

import jax
import numpy as np
import pytest
from surface import refusal

from experiments import make_flights
from experiments.flying.images import picture
from hybrid_jax.io.datasets import content_hash, load_dataset
from hybrid_jax.sim import flight as recording
from hybrid_jax.sim.domain import EXTERNAL_FORCE, SOURCE, Domain
from hybrid_jax.sim.flight import Flights, SplitSpec, cut, gone_wrong, make_dataset, permutation, random_flights
from hybrid_jax.vehicle import IRIS, Vehicle

pytestmark = pytest.mark.usefixtures("double_precision")


@pytest.fixture(scope="module")
def source(double_precision):
    return make_dataset(SOURCE, {"train": SplitSpec(200, 10), "test": SplitSpec(30, 100)}, seed=3)


def specs(dataset):
    return {name: SplitSpec(len(split), split.horizon) for name, split in dataset.splits.items()}


def level_flights(count, steps=40):
    states = np.zeros((count, steps + 1, 13))
    states[..., 2], states[..., 3] = 1.0, 1.0
    return Flights(states, np.zeros((count, steps, 4)), np.ones((count, steps + 1)), np.zeros(count))


def test_splits_have_the_windows_asked_for_in_single_precision_and_depend_on_the_seed_alone(source):
    for name, split in source.splits.items():
        spec = SplitSpec(**source.config["splits"][name])
        assert (split.x.shape, split.u.shape) == ((spec.windows, spec.steps, 13), (spec.windows, spec.steps, 4))
        assert split.x.dtype == split.u.dtype == split.x0.dtype == np.float32
    again = make_dataset(SOURCE, specs(source), seed=3)
    other = make_dataset(SOURCE, specs(source), seed=4)
    assert content_hash(again) == content_hash(source)
    assert not np.isin(other.splits["train"].x0[:, 0], source.splits["train"].x0[:, 0]).any()
    alone = make_dataset(SOURCE, {"test": specs(source)["test"]}, seed=3)
    np.testing.assert_array_equal(alone.splits["test"].x, source.splits["test"].x)


# A Crazyflie-like vehicle: a 55th of the mass of the Iris, a fifth of its size.
SMALL = Vehicle(
    mass=0.027, inertia=(1.66e-5, 1.66e-5, 2.93e-5), thrust_coefficient=2.88e-8, torque_coefficient=1.8e-10,
    rotor_positions=((0.033, -0.033), (-0.033, 0.033), (0.033, 0.033), (-0.033, -0.033)), spin=(-1.0, -1.0, 1.0, 1.0),
    rotor_radius=0.023, max_rotor_speed=2400.0,
)  # fmt: skip


@pytest.mark.slow
def test_a_small_vehicle_flies_as_well_as_the_iris():
    flights = random_flights(Domain("small", SMALL), 16, 11.0, jax.random.key(0))
    assert not gone_wrong(flights.states, SMALL).any()
    assert not (flights.lowest_rotor < 0).any()
    speed = np.linalg.norm(flights.states[..., 7:10], axis=-1)
    assert 1.5 < np.percentile(speed, 99) < 4  # that of the Iris, times the root of the scale


def test_flights_are_lively_and_partly_in_ground_effect(source):
    """What the paper's claims rest on: without low flight there is no residual, without rotation no inertia."""
    statistics = make_flights.survey(source.splits["train"])
    assert statistics["windows below 0.5 m"] > 0.15
    assert statistics["windows below 0.2 m"] > 0.05
    assert 3.5 < statistics["speed [m/s] p99"] < 7
    assert 25 < statistics["tilt [deg] p99"] < 45
    assert statistics["altitude [m] p99"] > 2
    assert statistics["distance from home [m] p99"] < 15


@pytest.mark.slow
def test_the_pilot_stays_in_bounds_in_wind_it_does_not_know():
    flights = random_flights(EXTERNAL_FORCE, 64, recording.SECONDS, jax.random.key(1))
    assert not gone_wrong(flights.states).any()
    assert flights.inputs.min() >= 0
    assert flights.inputs.max() <= IRIS.max_rotor_speed
    assert (flights.lowest_rotor < 0).mean() < 1e-3


@pytest.mark.parametrize("n", [0, 1, 2, 1000, 1625, 1626, 7040])
def test_an_order_is_that_of_jax(n):  # two rounds of sorting from 1626 on
    key = jax.random.key(n)
    np.testing.assert_array_equal(permutation(key, n), jax.random.permutation(key, n))


def test_a_flight_does_not_depend_on_how_many_are_flown():
    few, many = (random_flights(SOURCE, count, recording.SECONDS, jax.random.key(5)) for count in (2, 65))
    assert few.states.shape[0] == 2
    np.testing.assert_array_equal(few.states, many.states[:2])


@pytest.mark.parametrize(("sample", "rejected"), [(0, 1), (15, 1), (20, 2)])
def test_flights_that_go_wrong_and_windows_with_a_rotor_below_ground_are_dropped_and_counted(sample, rejected):
    flights, tally = level_flights(6), Counter()
    for place, value in {(1, 20, 11): np.nan, (2, 5, 0): 21.0, (3, 5, 8): 16.0, (4, 30, 2): -0.1}.items():
        flights.states[place] = value
    flights.lowest_rotor[0, sample] = -0.001  # sample 20 ends one window and starts the next
    assert sum(map(len, cut(flights, 10, tally))) == 8 - rejected
    assert tally == {"flights": 6, "dropped_flights": 4, "windows": 8 - rejected, "rejected_windows": rejected}


def test_splits_come_from_disjoint_flights_windows_do_not_overlap_and_it_is_said_if_every_flight_fails(monkeypatch):
    flown = []

    def numbered(domain, count, seconds, key):
        flights = level_flights(count)
        flights.states[..., 0] = len(flown) * 0.01 + np.arange(count)[:, None] * 1e-4  # which flight
        flights.states[..., 1] = np.arange(41) * 0.1  # which sample
        flown.append(jax.random.key_data(key).tolist())
        return flights

    monkeypatch.setattr(recording, "random_flights", numbered)
    dataset = make_dataset(SOURCE, {"a": SplitSpec(300, 10), "b": SplitSpec(150, 20)}, seed=0)
    numbers = {name: set(split.x0[:, 0].tolist()) for name, split in dataset.splits.items()}
    assert not numbers["a"] & numbers["b"]
    flights = sum(tally["flights"] for tally in dataset.metadata["tallies"].values())
    assert len({tuple(key) for key in flown}) == len(flown) == flights // 64
    starts = [(row[0], round(float(row[1]), 3)) for row in dataset.splits["a"].x0.tolist()]
    assert len(set(starts)) == 300
    assert {start for _, start in starts} == {0.0, 1.0, 2.0, 3.0}
    broken = level_flights(64)
    broken.states[:, 3, 2] = np.nan
    monkeypatch.setattr(recording, "random_flights", lambda *_: broken)
    splits = {"train": SplitSpec(1, 10)}
    refusal(lambda: make_dataset(SOURCE, splits, seed=0), "domain source: all 64 flights left the bounds")


def test_the_command_writes_a_dataset_prints_a_table_and_keeps_what_exists(tmp_path, monkeypatch, capsys):
    file = tmp_path / "source.npz"

    def call(train):
        options = "--domain", "source", "--output", str(file), "--train", str(train), "--validation", "10"
        monkeypatch.setattr("sys.argv", ["make_flights", *options])
        make_flights.main()

    call(20)
    assert "windows below 0.5 m" in capsys.readouterr().out
    before = file.read_bytes()
    assert len(load_dataset(file).splits["train"]) == 20
    call(20)
    for train, said in ((30, "splits.train.windows is 20, expected 30"), (-3, "--train must be")):
        with pytest.raises(SystemExit) as stop:
            call(train)
        assert stop.value.code == 2
        (message,) = capsys.readouterr().err.strip().splitlines()
        assert said in message
    assert file.read_bytes() == before


@pytest.mark.slow
def test_a_picture_is_drawn_or_the_missing_library_named(tmp_path):
    file = tmp_path / "vehicle.png"
    try:
        picture(file)
    except ValueError as error:
        assert "libosmesa6" in str(error)  # noqa: PT017 - machines without a renderer take this branch
    else:
        assert file.read_bytes().startswith(b"\x89PNG")


def test_no_renderer_is_one_line_that_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "none such")
    refusal(lambda: picture(tmp_path / "vehicle.png"), "libosmesa6 or libegl1")
    refusal(lambda: picture(tmp_path / "vehicle.jpg"), ".png")


def test_the_cache_is_flown_once_and_named_by_its_configuration(tmp_path, monkeypatch):
    splits = {"train": SplitSpec(5, 10)}
    first = make_flights.flights(SOURCE, splits, 0, tmp_path)
    monkeypatch.setattr(make_flights, "make_dataset", None)
    assert content_hash(make_flights.flights(SOURCE, splits, 0, tmp_path)) == content_hash(first)
    with pytest.raises(TypeError):
        make_flights.flights(SOURCE, splits, 1, tmp_path)
