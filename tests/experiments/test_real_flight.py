"""Folds around what the tool learns: which flights train and test, what is refused, and what a run writes."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import CONFIG, LOGS, OTHERS, write
from rich.console import Console
from surface import refusal

from experiments.real_flight.__main__ import main, prepare
from experiments.real_flight.config import PRESETS
from experiments.real_flight.report import cells, pooled, verdicts
from experiments.real_flight.simulated import vehicle_toml
from experiments.real_flight.study import ADAPTED, LEARNED, TAGS, make_folds, run_folds
from experiments.reporting import names
from experiments.reporting.results import Results
from experiments.runner.command import read
from experiments.runner.stages import Stages
from hybrid_jax.cli.logs import Flights
from hybrid_jax.dynamics.vehicle_file import VehicleModel
from hybrid_jax.flights.windows import manoeuvre_of
from hybrid_jax.identification.learning import UNITS
from hybrid_jax.vehicle import IRIS


@pytest.mark.parametrize(
    ("by", "tested"), [("flight", None), ("manoeuvre", None), ("flight", OTHERS), ("manoeuvre", OTHERS[:3])]
)
def test_every_flight_is_tested_once_by_models_of_others(by, tested):
    folds = make_folds(LOGS, tested, replace(CONFIG, folds_by=by))
    assert sorted(log.name for fold in folds for log in fold.test) == sorted(log.name for log in tested or LOGS)
    of = {"flight": lambda log: log.name, "manoeuvre": manoeuvre_of}[by]
    for fold in folds:
        assert not {of(log) for log in fold.train} & {of(log) for log in fold.test}


@pytest.mark.parametrize(
    ("options", "sets", "message"),
    [
        ({}, {"source": LOGS[:1]}, "--folds-by flight: all flights are of one name"),
        ({}, {"source": LOGS[:2]}, "--before: without chirp_run. one flight is left; two at least"),
        ({"horizon": (200,)}, {"source": LOGS}, "--horizon: no window of 200 intervals without gaps in /logs/"),
    ],
)
def test_too_few_or_short_flights_are_refused_before_training(options, sets, message, monkeypatch, tmp_path):
    monkeypatch.setattr(Stages, "kept", lambda *_: pytest.fail("training has begun"))
    flights = {name: Flights(each, {}, []) for name, each in sets.items()}
    with pytest.raises(ValueError, match=message):
        run_folds(replace(CONFIG, **options), VehicleModel(IRIS), flights, Stages(tmp_path, Console(quiet=True)))


def test_invalid_options_are_refused():
    refusal(lambda: replace(CONFIG, simulated=True, source=Path("a")), "--simulated makes its own logs")
    refusal(lambda: replace(CONFIG, learn=("wings",)), "learn must be names of")
    refusal(lambda: replace(CONFIG, dt=0.0), "--dt must be a positive finite number")


@pytest.mark.parametrize(("given", "said"), [([], "no logs at hand?"), (["--folds-by", "day"], "manoeuvre, got day")])
def test_guide_is_printed_without_flights_but_a_wrong_option_is_named_first(given, said, capsys):
    with pytest.raises(SystemExit) as stop:
        main(given)
    assert stop.value.code == 2
    assert said in capsys.readouterr().err.lower()


def test_lists_may_be_comma_separated():
    given = ["--horizon=10,50", "--before", "1,2", "--test=3,4", "--learn", "Ix,Iy", "k", "--polynomial", "-150.5,9e2"]
    config: Any = read("real_flight", "", [*given, "--topics", "imu=/imu,motors=/m:data:rpm"], PRESETS)
    assert (config.horizon, config.polynomial, config.learn) == ((10, 50), (-150.5, 900.0), ("Ix", "Iy", "k"))
    assert (config.source, config.test, config.topics) == (Path("1,2"), Path("3,4"), ("imu=/imu", "motors=/m:data:rpm"))


def test_a_flight_that_is_there_twice_is_refused_and_flights_count_once(tmp_path):
    (vehicle := tmp_path / "vehicle.toml").write_text(vehicle_toml(IRIS))
    same = replace(LOGS[0], name="/logs/chirp_run9.csv")
    folders = {"source": write(tmp_path / "source", LOGS[:2]), "test": write(tmp_path / "test", [same])}
    config = replace(CONFIG, vehicle=vehicle, **folders)
    refusal(lambda: prepare(config), "--test chirp_run9.csv.gz: the same flight as --before chirp_run1.csv.gz")
    prepare(replace(config, folds_by="manoeuvre"))  # each is tested by models of other manoeuvres
    write(folders["source"], [same])
    refusal(lambda: prepare(config), "chirp_run9", "the same flight as chirp_run1")
    rows = Results([row(LEARNED, 1.0), row(LEARNED, 3.0, flight="b"), row(LEARNED, 5.0, seed=1)], TAGS)
    np.testing.assert_allclose(pooled(rows, "10", "velocity"), [np.sqrt((1 + 9) / 2), 5])


def row(model, value, *, n=0, seed=0, flight="a", **columns):
    scores = {"10": dict.fromkeys(UNITS, value)}
    tags = dict(zip(TAGS, (flight, model, n, seed), strict=True))
    return tags | {"scores": scores, "theta": None, "theta_interval": None, "expected": None, "inside": None} | columns


@pytest.mark.parametrize(("noise", "decided"), [(0.01, True), (1.0, False)])
def test_verdicts_are_decided_by_ratios_of_errors_over_flights_and_seeds(noise, decided):
    rng = np.random.default_rng(0)

    def runs(model, value, seeds=(0, 1, 2), n=0):
        return [row(model, value * np.exp(noise * rng.normal()), seed=s, flight=f, n=n) for f in "abcd" for s in seeds]

    rows = runs(ADAPTED, 1.0, n=100) + runs(names.SCRATCH, 2.0, n=100) + runs(LEARNED, 0.5)
    rows += runs(names.HOLD, 4.0, (0,)) + runs(names.PHYSICS_ONLY, 0.9)
    found = {each.id: each for each in verdicts(cells(Results(rows, TAGS)), (ADAPTED, 100))}
    if decided:
        assert {id: each.holds for id, each in found.items()} == {"F1": True, "F2": False, "F3": True, "F4": False}
        (ratio,) = re.findall(r"step 10 velocity (\S+) \(", found["F1"].measured)
        assert float(ratio) == pytest.approx(0.25, rel=0.03)
    else:
        assert found["F2"].holds is None
