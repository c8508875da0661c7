"""Learning from recorded flights: what is judged was never learned from, and bad logs end in one line."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax
from experiments import real_flight
from experiments.flight_folds import apart, drawn, folds_of, lessons
from experiments.flight_logs import Windows, cut, fly_in, require_one_rate
from experiments.flight_models import Craft, Kinematics, Lane, fresh, moved, settings_of
from experiments.flight_protocol import RealFlightConfig
from experiments.flight_recipes import RECIPES, stage_of
from experiments.flight_tests import body_of, parameters, scores
from experiments.simulated_logs import csv_of, vehicle_toml
from hybrid_jax.channels import ChannelPrediction, channels_from
from hybrid_jax.flight_claims import flight_claims
from hybrid_jax.flight_rows import QUANTITIES, FlightRow, pooled
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.lanes import count, lane
from hybrid_jax.multirotor import Terms
from hybrid_jax.rollout import rollout, rollout_batch
from hybrid_jax.rotation import angle_between
from hybrid_jax.schedule import rates_by_group
from hybrid_jax.state import POSITION, QUATERNION
from hybrid_jax.vehicle import IRIS

ROOT = Path(__file__).parents[1]
REAL = Path(os.environ.get("HYBRID_JAX_FLIGHTS", ROOT.parent / "shared" / "flights"))
DT, SAMPLES = 0.01, 90
CONFIG = RealFlightConfig(horizon=(5,), n=(100,), validation=10)
CRAFT = Craft(IRIS, Terms())

needs_flights = pytest.mark.skipif(
    not (REAL / "nanodrone").exists(), reason="no real flights: set HYBRID_JAX_FLIGHTS to their folder"
)


def flights(names, seed=0):
    """Short flights near hover, of a rigid body."""
    rng = np.random.default_rng(seed)
    x0 = np.zeros((len(names), 13), np.float32)
    x0[:, 3], x0[:, 2], x0[:, 7:] = 1, 2, rng.normal(0, 0.1, (len(names), 6))
    u = IRIS.hover_speed + rng.normal(0, 5, (len(names), SAMPLES - 1, 4)).astype(np.float32)
    x = np.concatenate([x0[:, None], rollout_batch(hybrid_jax.rigid_body(IRIS), x0, u, DT)], axis=1)
    u = np.concatenate([u, u[:, -1:]], axis=1)
    return [FlightLog(DT * np.arange(SAMPLES), *both, name) for *both, name in zip(x, u, names, strict=True)]


LOGS = flights([f"/logs/{kind}_run{i}.csv" for kind in ("chirp", "random", "square") for i in (1, 2, 3)])
OTHERS = flights([f"/more/{kind}_run4.csv" for kind in ("chirp", "random", "square", "melon")], seed=1)


def samples(windows):
    """Every state in some windows, as bytes."""
    states = np.concatenate([windows.x0[:, None], windows.x], axis=1).reshape(-1, 13)
    return {state.tobytes() for state in states}


CASES = {
    "by flight": ({}, None),
    "by manoeuvre": ({"folds_by": "manoeuvre", "validate_by": "manoeuvre"}, None),
    "tests given": ({}, OTHERS),
    "tests given, by manoeuvre": ({"folds_by": "manoeuvre"}, OTHERS[:3]),
}


@pytest.mark.parametrize("case", CASES)
def test_nothing_that_judges_was_learned_from(case):
    options, tested = CASES[case]
    config = replace(CONFIG, **options)
    folds = folds_of(LOGS, tested, config)
    held_out = [log.name for fold in folds for log in fold.test]
    assert sorted(held_out) == sorted(log.name for log in tested or LOGS)  # each is tested once
    for fold in folds:
        found = lessons(fold, 5, 2, 10)
        learned, stopping, judging = map(samples, (found.train.windows, found.validation, cut(fold.test, 5).windows))
        assert not learned & judging
        assert not stopping & judging
        assert not learned & stopping


def test_a_manoeuvre_that_judges_is_in_no_flight_that_teaches():
    for fold in folds_of(LOGS, OTHERS[:3], replace(CONFIG, folds_by="manoeuvre")):
        taught = {log.name.split("_run")[0].split("/")[-1] for log in (*fold.train, *fold.validation)}
        assert not taught & set(fold.name.split(", "))


def test_weights_of_channels_come_from_training_windows_alone():
    """The same with other validation and test flights."""
    fold = folds_of(LOGS, None, CONFIG)[0]
    other = replace(fold, validation=OTHERS[:2], test=OTHERS[2:])
    one, two = (settings_of(CRAFT, lessons(each, 5, 2, 10), RECIPES["staged"], 100) for each in (fold, other))
    assert one.objective == two.objective


def test_a_recipe_says_how_little_position_counts_and_nothing_else_changes():
    few = lessons(folds_of(LOGS, None, CONFIG)[0], 5, 2, 10)
    recipes = (replace(RECIPES["staged"], position=factor) for factor in (1.0, 10.0))
    one, ten = (settings_of(CRAFT, few, recipe, 100).objective.channels for recipe in recipes)
    assert (one[0].start, one[0].stop) == (POSITION.start, POSITION.stop)
    assert ten == (replace(one[0], scale=10 * one[0].scale), *one[1:])


def test_random_draws_are_nested_and_contiguous_ones_are_runs():
    sizes = [40, 60, 50]
    few, many = (drawn(sizes, n, "random", 3) for n in (20, 100))
    np.testing.assert_array_equal(few, many[:20])
    starts = np.cumsum([0, *sizes])
    for seed in range(5):
        for n in (30, 60, 75, 150):
            found = drawn(sizes, n, "contiguous", seed)
            assert len(set(found.tolist())) == n
            runs = [found[(found >= a) & (found < b)] for a, b in pairwise(starts)]
            assert all((np.diff(run) == 1).all() for run in runs)
            assert sum(0 < len(run) < size for run, size in zip(runs, sizes, strict=True)) <= 1
    with pytest.raises(ValueError, match="--n 151: the training flights have only 150 windows"):
        drawn(sizes, 151, "contiguous", 0)


def test_windows_apart_share_no_sample():
    np.testing.assert_array_equal(apart(np.array([9, 0, 3, 5, 11, 10]), [10, 5], 4), [0, 5, 9, 10])


def test_kinematics_move_and_turn_at_constant_rates():
    x0 = np.array([1, 2, 3, 1, 0, 0, 0, 0.5, -1, 2, 0.3, -0.2, 0.5], np.float32)
    x = rollout(Kinematics(), x0, np.zeros((50, 4), np.float32), DT)
    np.testing.assert_allclose(x[-1, :3], x0[:3] + 0.5 * x0[7:10], rtol=1e-5)
    np.testing.assert_array_equal(x[-1, 7:], x0[7:])
    angle = angle_between(x[-1, QUATERNION], jnp.asarray(x0[QUATERNION]))
    np.testing.assert_allclose(angle, 0.5 * np.linalg.norm(x0[10:]), rtol=1e-4)


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("model", ["hybrid", "no_physics", "physics_only"])
def test_every_model_begins_as_its_physics_and_every_step_moves_it(model, recipe):
    fields = fresh(model, CRAFT, RECIPES[recipe], 4, 2)
    assert count(fields) == 2
    one = lane(fields, 0)
    x, u = LOGS[0].x[0].astype(np.float32), LOGS[0].u[0].astype(np.float32)
    begin = Kinematics() if model == "no_physics" else CRAFT.physics(RECIPES[recipe])
    np.testing.assert_allclose(one(x, u), begin(x, u), rtol=1e-6)
    for step in (*RECIPES[recipe].source, *RECIPES[recipe].adaptation, *RECIPES[recipe].scratch):
        rates = jax.tree.leaves(rates_by_group(one, stage_of(step, model).rates))
        assert any(rate > 0 for rate in rates)
        assert step.steps <= RECIPES[recipe].window


def test_a_model_that_is_carried_over_keeps_its_parameters():
    heavier = replace(IRIS, mass=2.0)
    fields = fresh("hybrid", CRAFT, RECIPES["staged"], 4, 2)
    fields = eqx.tree_at(lambda f: f.physics.deviations["drag"], fields, np.full((2, 3), 0.1, np.float32))
    carried = moved(fields, heavier)
    for index in range(2):
        was, now = (body_of(lane(each, index)).theta() for each in (fields, carried))
        for name, value in was.items():
            np.testing.assert_allclose(now[name], value, rtol=1e-5)
    assert carried.physics.vehicle == heavier


def test_parameters_of_a_lane_have_intervals_around_them():
    windows = cut(LOGS, 10, 5)
    lanes = [Lane(seed, np.arange(len(windows)), 1.0) for seed in range(2)]
    craft = replace(CRAFT, learn=("Ix", "k_rotors"))
    noisy = windows.windows.x + np.random.default_rng(0).normal(0, 1e-3, windows.windows.x.shape).astype(np.float32)
    noisy = Windows(eqx.tree_at(lambda w: w.x, windows.windows, noisy), windows.sizes, windows.stride)
    objective = ChannelPrediction(channels_from(CRAFT.thrust(), noisy.windows), 1.0)
    for found in parameters(fresh("hybrid", craft, RECIPES["staged"], 4, 2), lanes, noisy, objective):
        assert set(found["theta"]) == {"Ix", *(f"k_rotors[{i}]" for i in range(4))}
        for name, (low, high) in found["theta_interval"].items():
            assert 0 < low < found["theta"][name] < high
            # Positive: symmetric in the logarithm.
            np.testing.assert_allclose(low * high, found["theta"][name] ** 2, rtol=1e-4)
    few = [Lane(0, np.arange(3), 1.0)]
    (found,) = parameters(fresh("hybrid", craft, RECIPES["staged"], 4, 1), few, noisy, objective)
    assert found["theta"]["Ix"] == pytest.approx(IRIS.inertia[0])
    assert found["theta_interval"] is None


def test_the_nanodrone_score_is_the_mean_error_of_each_step_summed():
    rms, mean = np.full((4, 60), 2.0), np.tile(np.arange(1.0, 61), (4, 1))
    found = scores(rms, mean, replace(CONFIG, protocol="nanodrone"))
    assert found["5"] == dict.fromkeys(QUANTITIES, 2.0)
    assert found["sum"] == dict.fromkeys(QUANTITIES, 50 * 51 / 2)


def row(mode, value, *, n=100, seed=0, fold="a", windows=1, model="hybrid"):
    errors = dict.fromkeys(QUANTITIES, value)
    return FlightRow(fold, model, mode, n, seed, "staged", windows, {"10": errors, "sum": errors})


def test_folds_are_pooled_by_their_windows():
    rows = [row("scratch", 1.0), row("scratch", 3.0, fold="b", windows=3), row("scratch", 5.0, seed=1)]
    np.testing.assert_allclose(pooled(rows, "10", "velocity"), [np.sqrt((1 + 3 * 9) / 4), 5])
    np.testing.assert_allclose(pooled(rows, "sum", "velocity"), [(1 + 9) / 4, 5])


def test_claims_say_by_how_much():
    rows = [row("fine_tuned", 1.0), row("scratch", 2.0), row("zero_shot", 0.5, n=0)]
    rows += [row("nominal", 4.0, n=0, model="hold"), row("fine_tuned", 0.9, model="no_physics")]
    verdicts = {claim.id: claim.holds for claim in flight_claims(rows)}
    assert verdicts == {"F1": True, "F2": False, "F3": True, "F4": False}
    assert "step 10 velocity 0.25" in flight_claims(rows)[0].measured


# Folders of logs, sound but for one thing.


def write(folder, logs):
    for log in logs:
        path = folder / Path(log.name).name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_name(f"{path.name}.gz").write_bytes(csv_of(log.t, log.x, log.u))
    return folder


def test_logs_are_read_checked_and_cleaned_as_asked(tmp_path):
    source = write(tmp_path / "source", LOGS[:2])
    cleaning = replace(CONFIG.cleaning, resample=0.02, low_pass=20.0, delay=0.02)
    found = fly_in("source", source, IRIS, 0.01, replace(CONFIG, cleaning=cleaning))
    assert [record["flight"] for record in found.records] == ["chirp_run1", "chirp_run2"]
    for record in found.records:
        assert [line.split()[0] for line in record["done"]] == ["resampled", "low-pass", "motors", "rotors"]
        assert record["samples"] == SAMPLES
        assert len(record["checks"]) == 9
    assert require_one_rate([found]) == 0.02


def test_logs_of_two_rates_are_refused_with_what_to_do(tmp_path):
    slow = [replace(LOGS[1], t=2 * LOGS[1].t)]
    found = fly_in("source", write(tmp_path, [LOGS[0], *slow]), IRIS, 0.0, CONFIG)
    with pytest.raises(ValueError, match=r"chirp_run2.*0.02 s apart.*--cleaning.resample 0.02"):
        require_one_rate([found])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"n": (50,)}, "--n must each be at least --batch-size 100"),
        ({"horizon": (0,)}, "--horizon must be at least 1"),
        ({"simulated": True, "source": Path("a")}, "--simulated makes its own logs"),
        ({"learn": ("wings",)}, "learn must be names of"),
        ({"epochs": 0.0}, "--epochs must be a positive number"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, said):
    with pytest.raises(ValueError, match=said):
        replace(CONFIG, **options)


def test_too_few_flights_are_refused():
    with pytest.raises(ValueError, match="--folds-by flight: all flights are of one name"):
        folds_of(LOGS[:1], None, CONFIG)
    with pytest.raises(ValueError, match="--validate-by flight: 1 flights of one name"):
        folds_of(LOGS[:1], OTHERS, CONFIG)
    with pytest.raises(ValueError, match="no window of 200 intervals"):
        cut(LOGS, 200)


def test_without_flights_it_says_how_to_get_some(capsys):
    with pytest.raises(SystemExit) as stop:
        real_flight.main([])
    assert stop.value.code == 2
    assert "--simulated" in capsys.readouterr().err


def test_numbers_may_be_joined_by_commas():
    given = ["--n", "100,300", "--horizon=10,50", "--source", "a,b", "--epochs", "0.5"]
    expected = ["--n", "100", "300", "--horizon", "10", "50", "--source", "a,b", "--epochs", "0.5"]
    assert real_flight.spaced(given) == expected


def command(*options, folder):
    arguments = ["--out", str(folder / "out"), "--cache", str(folder / "cache"), *options]
    run = [sys.executable, "-m", "experiments.real_flight", "--preset", "smoke", *arguments]
    return subprocess.run(run, capture_output=True, text=True, cwd=ROOT, env=os.environ | {"MPLBACKEND": "agg"})


def test_a_bad_log_ends_in_one_line_that_names_file_row_and_field(tmp_path):
    (tmp_path / "vehicle.toml").write_text(vehicle_toml(IRIS))
    source = write(tmp_path / "source", LOGS[:3])
    text = (
        "t,px,py,pz,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,u0,u1,u2,u3\n"
        + "0,0,0,1,1,0,0,0,0,0,0,0,0,0,600,600,600,600\n"
        + "0.01,0,0,1,1,0,0,0,nan,0,0,0,0,0,600,600,600,600\n"
    )
    (source / "bad.csv").write_text(text)
    run = command("--vehicle", str(tmp_path / "vehicle.toml"), "--source", str(source), folder=tmp_path)
    assert run.returncode == 2
    (line,) = run.stderr.strip().splitlines()
    assert line.startswith(f"real_flight: {source / 'bad.csv'}: row 3, field vx: ")
    left = (tmp_path / "out" / "real_flight").iterdir()
    assert [path.name for path in left] == [".lock"]  # nothing is written half


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated")
    run = command("--simulated", folder=folder)
    assert run.returncode == 0, run.stderr
    return folder / "out" / "real_flight", run


def test_simulated_logs_go_all_the_way(simulated):
    out, run = simulated
    report = json.loads((out / "report.json").read_text())
    assert {"versions", "hardware", "seconds"} <= set(report["environment"])
    assert report["config"]["preset"] == "smoke"
    # Two folds: hold, thrust, two linear residuals; two models zero-shot and fine-tuned, the hybrid from scratch.
    assert len(report["rows"]) == 2 * (4 + 2 * 2 + 1)
    for found in report["rows"]:
        assert set(found["scores"]) == {"5", "10"}
        assert all(set(errors) == set(QUANTITIES) for errors in found["scores"].values())
        assert (found["theta"] is None) == (found["model"] not in ("hybrid", "physics_only"))
    for fold in report["folds"]:
        assert not set(fold["test"]) & {*fold["train"], *fold["validation"]}
    assert sum(map(len, report["logs"].values())) == 16
    page = (out / "report.md").read_text()
    for figure in report["figures"]:
        assert (out / figure).read_bytes().startswith(b"\x89PNG")
        assert f"({figure})" in page
    assert "Consistency of each log" in page
    assert "Traceback" not in run.stderr


def test_models_of_a_run_load_and_predict(simulated):
    out, _ = simulated
    model = hybrid_jax.load(out / "models" / "fold0-hybrid-fine_tuned-20-seed0.npz")
    assert model.about["dt"] == DT
    assert np.isfinite(model.predict(LOGS[0].x[0], LOGS[0].u[:5], DT)).all()


@needs_flights
@pytest.mark.parametrize(
    ("name", "by", "count"), [("crazyflie_payload/payload", "flight", 3), ("nanodrone/train", "manoeuvre", 3)]
)
def test_real_flights_are_parted_without_leaks(name, by, count):
    vehicle = hybrid_jax.load_vehicle(REAL / name.split("/")[0] / "vehicle.toml")
    flown = fly_in("source", REAL / name, vehicle, 0.0, CONFIG)
    assert require_one_rate([flown]) == DT
    folds = folds_of(flown.logs, None, replace(CONFIG, folds_by=by))
    assert len(folds) == count
    for fold in folds:
        found = lessons(fold, 25, 25, 10)
        assert not (samples(found.train.windows) | samples(found.validation)) & samples(cut(fold.test, 50, 50).windows)
