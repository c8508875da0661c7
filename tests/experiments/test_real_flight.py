"""Training on recorded flights: training, validation and test share no sample."""

import os
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from recorded import CONFIG, DT, LOGS, OTHERS, SAMPLES, samples, windows_of_fold
from rich.console import Console

import hybrid_jax
from experiments.real_flight import study, train
from experiments.real_flight.config import LEARN
from experiments.real_flight.figures import errors_by_size
from experiments.real_flight.folds import make_folds, non_overlapping, sampled_indices
from experiments.real_flight.logs import LogSet, load_logs
from experiments.real_flight.models import RECIPES, thrust_baseline, untrained
from experiments.real_flight.report import parameter_tables
from experiments.real_flight.scoring import QUANTITIES, TAGS, parameters, pooled, scores, verdicts
from experiments.real_flight.study import run_folds
from experiments.real_flight.train import Experiment, TrainedModel, TrainingData
from experiments.reporting.results import Results
from experiments.runner.stages import Stages
from hybrid_jax.dynamics.baselines import Kinematics
from hybrid_jax.dynamics.vehicle_file import VehicleModel
from hybrid_jax.flights.windows import LogWindows, count_windows, cut_windows, require_common_interval
from hybrid_jax.integrate import rollout
from hybrid_jax.networks.mlp import ResidualNetwork
from hybrid_jax.training.channels import ChannelLoss, channels_from
from hybrid_jax.vehicle import IRIS

ROOT = Path(__file__).parents[2]
REAL = Path(os.environ.get("HYBRID_JAX_FLIGHTS", ROOT.parent / "shared" / "flights"))
MODEL = VehicleModel(IRIS, learn=LEARN)

CASES = {
    "by flight": ({}, None),
    "by manoeuvre": ({"folds_by": "manoeuvre", "validate_by": "manoeuvre"}, None),
    "tests given": ({}, OTHERS),
    "tests given, by manoeuvre": ({"folds_by": "manoeuvre"}, OTHERS[:3]),
}


@pytest.mark.parametrize("case", CASES)
def test_training_validation_and_test_share_no_sample(case):
    options, tested = CASES[case]
    config = replace(CONFIG, **options)
    folds = make_folds(LOGS, tested, config)
    held_out = [log.name for fold in folds for log in fold.test]
    assert sorted(held_out) == sorted(log.name for log in tested or LOGS)  # each is tested once
    for fold in folds:
        train, validation, test = map(samples, windows_of_fold(fold, 5, 2))
        assert not train & test
        assert not validation & test
        assert not train & validation


def test_test_manoeuvres_are_not_trained_on():
    for fold in make_folds(LOGS, OTHERS[:3], replace(CONFIG, folds_by="manoeuvre")):
        trained = {log.name.split("_run")[0].split("/")[-1] for log in (*fold.train, *fold.validation)}
        assert not trained & set(fold.name.split(", "))


def test_counted_windows_are_those_of_the_logs():
    gap = LOGS[1][[*range(20), *range(40, SAMPLES)]]
    assert count_windows([LOGS[0], gap], 25) == len(cut_windows([LOGS[0], gap], 25)) == 65 + 25


SHORT = [log[:30] for log in LOGS]


@pytest.mark.parametrize(
    ("options", "flights", "message"),
    [
        ({"n": (100, 400)}, {"source": LOGS, "target": LOGS}, "--n 400: the training flights have only 325 windows"),
        ({"horizon": (40,)}, {"source": LOGS, "target": [*LOGS[:3], *SHORT[3:]]}, "no window of 40 intervals"),
        ({}, {"source": LOGS, "test": [log[:5] for log in OTHERS]}, "no window of 5 intervals"),
        ({"recipes": ("frozen_rates",)}, {"source": SHORT, "target": LOGS}, "no window of 50 intervals"),
        ({"recipes": ("frozen_rates",)}, {"source": LOGS, "target": SHORT}, "no window of 50 intervals"),
        ({"horizon": (40,), "recipes": ("staged", "turning")}, {"source": SHORT, "test": LOGS}, "no window of 40"),
    ],
)
def test_short_flights_are_refused_before_training(options, flights, message, monkeypatch, tmp_path):
    monkeypatch.setattr(Stages, "sweep", lambda *_: pytest.fail("training has begun"))
    config = replace(CONFIG, cache=tmp_path, target=tmp_path if "target" in flights else None, **options)
    logs = {name: LogSet(name, each, []) for name, each in flights.items()}
    with pytest.raises(ValueError, match=message):
        run_folds(Experiment(config, MODEL, MODEL, logs, DT, Stages(tmp_path, Console(quiet=True))))


def test_random_samples_are_nested_and_contiguous_ones_are_runs():
    sizes = [40, 60, 50]
    few, many = (sampled_indices(sizes, n, "random", 3) for n in (20, 100))
    np.testing.assert_array_equal(few, many[:20])
    starts = np.cumsum([0, *sizes])
    for seed in range(5):
        for n in (30, 60, 75, 150):
            found = sampled_indices(sizes, n, "contiguous", seed)
            assert len(set(found.tolist())) == n
            runs = [found[(found >= a) & (found < b)] for a, b in pairwise(starts)]
            assert all((np.diff(run) == 1).all() for run in runs)
            assert sum(0 < len(run) < size for run, size in zip(runs, sizes, strict=True)) <= 1
    begins = {int(sampled_indices([3, 6, 4], 4, "contiguous", seed)[0]) for seed in range(200)}
    assert begins == {3, 4, 5, 9}  # all that leave room in one flight


def test_networks_have_the_activation_of_the_options(monkeypatch):
    monkeypatch.setattr(train, "in_stages", lambda *given: given[2])  # the models as training would begin
    experiment = Experiment(replace(CONFIG, activation="tanh"), MODEL, MODEL, {}, DT, None)
    windows = cut_windows(LOGS, 10, 5)
    data = TrainingData(windows, windows.windows, None, len(windows))
    first = train.train_on_source(experiment, "source", "hybrid", "staged", data, 1)
    for each in (first, train.adapt(experiment, "target", "scratch", first, data, [20])):
        nodes = jax.tree.leaves(each.fields, is_leaf=lambda node: isinstance(node, ResidualNetwork))
        assert [node.activation for node in nodes if isinstance(node, ResidualNetwork)] == ["tanh"]


def test_non_overlapping_windows_share_no_sample():
    np.testing.assert_array_equal(non_overlapping(np.array([9, 0, 3, 5, 11, 10]), [10, 5], 4), [0, 5, 9, 10])


def test_kinematics_move_and_turn_at_constant_rates():
    x0 = np.array([1, 2, 3, 1, 0, 0, 0, 0.5, -1, 2, 0.3, -0.2, 0.5], np.float32)
    x = rollout(Kinematics(), x0, np.zeros((50, 4), np.float32), DT)
    np.testing.assert_allclose(x[-1, :3], x0[:3] + 0.5 * x0[7:10], rtol=1e-5)
    np.testing.assert_array_equal(x[-1, 7:], x0[7:])
    angle = 2 * np.arctan2(np.linalg.norm(x[-1, 4:7]), x[-1, 3])
    np.testing.assert_allclose(angle, 0.5 * np.linalg.norm(x0[10:]), rtol=1e-4)


def test_parameters_have_intervals_around_them():
    windows = cut_windows(LOGS, 10, 5)
    noise = np.random.default_rng(0).normal(0, 1e-3, windows.windows.x.shape).astype(np.float32)
    noisy = eqx.tree_at(lambda w: w.x, windows.windows, windows.windows.x + noise)
    objective = ChannelLoss(channels_from(thrust_baseline(MODEL), noisy), 1.0)
    data = TrainingData(LogWindows(noisy, windows.sizes, windows.stride), noisy, objective, len(noisy))

    def found(seeds, indices):
        fields = untrained("hybrid", replace(MODEL, learn=("Ix", "k_rotors")), RECIPES["staged"], 4, seeds)
        model = TrainedModel("hybrid", "source_only", "staged", fields, range(seeds), [indices] * seeds)
        return parameters(model, data)

    for each in found(2, np.arange(len(windows))):
        assert set(each["theta"]) == {"Ix", *(f"k_rotors[{i}]" for i in range(4))}
        for name, (low, high) in each["theta_interval"].items():
            assert 0 < low < each["theta"][name] < high
            # Positive: symmetric in the logarithm.
            np.testing.assert_allclose(low * high, each["theta"][name] ** 2, rtol=1e-4)
    (few,) = found(1, np.arange(3))
    assert few["theta"]["Ix"] == pytest.approx(IRIS.inertia[0])
    assert few["theta_interval"] is None


def test_nanodrone_score_sums_the_mean_error_of_each_step():
    rms, mean = np.full((4, 60), 2.0), np.tile(np.arange(1.0, 61), (4, 1))
    found = scores(rms, mean, replace(CONFIG, protocol="nanodrone"))
    assert found["5"] == dict.fromkeys(QUANTITIES, 2.0)
    assert found["sum"] == dict.fromkeys(QUANTITIES, 50 * 51 / 2)


def row(mode, value, *, n=100, seed=0, fold="a", windows=1, model="hybrid", **columns):
    errors = dict.fromkeys(QUANTITIES, value)
    tags = dict(zip(TAGS, (fold, model, mode, n, seed), strict=True))
    return tags | {"windows": windows, "scores": {"10": errors, "sum": errors}} | columns


def test_folds_are_pooled_by_their_windows():
    rows = Results([row("scratch", 1.0), row("scratch", 3.0, fold="b", windows=3), row("scratch", 5.0, seed=1)], TAGS)
    np.testing.assert_allclose(pooled(rows, "10", "velocity"), [np.sqrt((1 + 3 * 9) / 4), 5])
    np.testing.assert_allclose(pooled(rows, "sum", "velocity"), [(1 + 9) / 4, 5])


@pytest.mark.parametrize(("noise", "decided"), [(0.01, True), (1.0, False)])
def test_verdicts_are_decided_by_ratios_of_errors_over_flights_and_seeds(noise, decided):
    rng = np.random.default_rng(0)

    def runs(mode, value, seeds=range(3), **columns):
        sizes = np.exp(noise * rng.normal(size=(4, len(seeds))))
        return [
            row(mode, value * sizes[i, s], seed=s, replicate=flight, **columns)
            for i, flight in enumerate("abcd")
            for s in seeds
        ]

    rows = runs("fine_tuned", 1.0) + runs("scratch", 2.0) + runs("zero_shot", 0.5, n=0)
    rows += runs("nominal", 4.0, [0], n=0, model="hold") + runs("fine_tuned", 0.9, model="no_physics")
    found = {each.id: each for each in verdicts(Results(rows, (*TAGS, "replicate")))}
    if decided:
        assert {id: each.holds for id, each in found.items()} == {"F1": True, "F2": False, "F3": True, "F4": False}
        ratio = float(re.search(r"step 10 velocity (\S+) \(", found["F1"].measured)[1])
        assert ratio == pytest.approx(0.25, rel=0.03)
    else:
        assert found["F2"].holds is None


@pytest.mark.parametrize(
    ("second", "text"),
    [
        ({"Ix": 3.0, "drag": 5.0}, "4 ± 1 [3, 5]"),
        ({"Ix": 3.0}, "3 [2, 4] (1 of 2 folds)"),  # its recipe learns no drag
        ({"Ix": 3.0, "drag": None}, "nan ± nan [2, 4]"),  # its drag is not finite
    ],
)
def test_parameter_is_the_mean_over_folds_that_learn_it(second, text):
    rows = []
    for fold, theta in {"a": {"Ix": 2.0, "drag": 3.0}, "b": second}.items():
        ends = {name: [value - 1, value + 1] for name, value in theta.items() if value is not None}
        rows.append(row("source_only", 1.0, n=0, fold=fold, theta=theta, theta_interval=ends))
    (table,) = parameter_tables(Results(rows, TAGS), {"Ix": 1.0, "drag": 0.0})
    assert [line[-1] for line in table.lines] == ["2.5 ± 0.7 [1.5, 3.5]", text]


@pytest.mark.parametrize("sizes", [(20,), (100, 1000)])
def test_errors_are_drawn_over_the_baselines_at_their_number_of_windows(sizes):
    rows = [row("zero_shot", 1.0, n=0), row("nominal", 2.0, n=0, model="thrust")]
    rows += [row(mode, 1.0, n=n) for n in sizes for mode in ("fine_tuned", "scratch")]
    rows = Results([each | {"scores": {"10": each["scores"]["10"]}} for each in rows], TAGS)
    for axes in errors_by_size(rows, DT, "").axes:
        curves = [line for line in axes.lines if line.get_marker() == "o"]
        assert [list(line.get_xdata()) for line in curves] == [list(sizes)] * 2
        np.testing.assert_allclose([line.get_ydata() for line in curves], 0.5)
        np.testing.assert_array_less(1.04, [min(sizes) / axes.get_xlim()[0], axes.get_xlim()[1] / max(sizes)])


@pytest.mark.skipif(not (REAL / "nanodrone").exists(), reason="no real flights: set HYBRID_JAX_FLIGHTS to their folder")
@pytest.mark.parametrize(
    ("name", "by", "count"), [("crazyflie_payload/payload", "flight", 3), ("nanodrone/train", "manoeuvre", 3)]
)
def test_folds_of_real_flights_share_no_sample(name, by, count):
    vehicle = hybrid_jax.load_vehicle(REAL / name.split("/")[0] / "vehicle.toml")
    logs = load_logs("source", REAL / name, vehicle, 0.0, CONFIG).logs
    assert require_common_interval(logs) == DT
    folds = make_folds(logs, None, replace(CONFIG, folds_by=by))
    assert len(folds) == count
    for fold in folds:
        train, validation, test = map(samples, windows_of_fold(fold, 25, 25))
        assert not (train | validation) & test


@pytest.mark.slow
def test_programs_of_the_previous_fold_are_freed(monkeypatch):
    """Otherwise many folds need more memory maps than Linux gives a process."""
    kept, twice = [], jax.jit(lambda x: 2 * x)

    def run_fold(experiment, outputs, number, source):
        twice(np.zeros(number + 3)).block_until_ready()  # another program for each shape
        kept.append(len(jax.devices()[0].client.live_executables()))

    monkeypatch.setattr(study, "_run_fold", run_fold)
    config = replace(CONFIG, stride=1)
    run_folds(Experiment(config, MODEL, MODEL, {"source": LogSet("source", LOGS, [])}, DT, None))
    assert len(kept) > 1
    assert kept[-1] <= kept[0]
