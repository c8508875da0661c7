"""From options to a report: what is refused and what is written."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from recorded import CONFIG, DT, LOGS, OTHERS, write
from rich.console import Console
from smoke import command, experiments, refused, script

from experiments.real_flight.__main__ import LISTS, load_vehicle_models, main, prepare
from experiments.real_flight.config import PRESETS, RealFlightConfig
from experiments.real_flight.folds import make_folds
from experiments.real_flight.scoring import QUANTITIES
from experiments.real_flight.simulated import vehicle_toml
from experiments.runner.command import read
from hybrid_jax.cli.command import FAILED_CHECKS, ChecksFailed, split_lists
from hybrid_jax.dynamics.vehicle_file import LAG
from hybrid_jax.flights.windows import cut_windows
from hybrid_jax.vehicle import IRIS


@pytest.fixture
def vehicle(tmp_path):
    path = tmp_path / "vehicle.toml"
    path.write_text(vehicle_toml(IRIS))
    return path


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n": (50,)}, "--n must each be at least --batch-size 100"),
        ({"horizon": (0,)}, "--horizon must be an integer of at least 1"),
        ({"simulated": True, "source": Path("a")}, "--simulated makes its own logs"),
        ({"learn": ("wings",)}, "learn must be names of"),
        ({"epochs": 0.0}, "--epochs must be a positive finite number"),
    ],
)
def test_invalid_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **options)


@pytest.mark.parametrize("asked", [{"protocol": "nanodrone"}, {"folds_by": "manoeuvre"}], ids=str)
def test_defaults_for_predicting_other_manoeuvres(asked):
    usual, config = PRESETS["paper"], replace(PRESETS["paper"], **asked)
    assert (config.tried, config.validated_by) == (("frozen_rates", "torque_off", "staged"), "manoeuvre")
    assert config.described()["recipes"] == config.tried  # so that a resumed run, and a reader, knows them
    adapted = replace(config, target=Path("after"))
    assert (adapted.tried, adapted.validated_by) == (usual.tried, usual.validated_by) == (("turning",), "flight")
    own = replace(config, recipes=("short",), validate_by="flight")
    assert (own.tried, own.validated_by) == (("short",), "flight")


def test_too_few_flights_are_refused():
    with pytest.raises(ValueError, match="--folds-by flight: all flights are of one name"):
        make_folds(LOGS[:1], None, CONFIG)
    with pytest.raises(ValueError, match="--validate-by flight: 1 flights of one name"):
        make_folds(LOGS[:1], OTHERS, CONFIG)
    with pytest.raises(ValueError, match="no window of 200 intervals"):
        cut_windows(LOGS, 200)


def with_lag(folder):
    """A vehicle file with rotors whose lag is stated, and is to be learned."""
    path = folder / "vehicle.toml"
    path.write_text(f'learn = ["Ix", "{LAG}"]\n{vehicle_toml(IRIS)}[terms]\n{LAG} = 0.03\n')
    return path


@pytest.mark.parametrize(
    "options", [{}, {"test": Path("test"), "folds_by": "manoeuvre"}, {"folds_by": "manoeuvre"}], ids=str
)
def test_lag_is_not_chosen_on_test_flights(options, tmp_path):
    config = replace(CONFIG, vehicle=with_lag(tmp_path), source=tmp_path, **options)
    with pytest.raises(ValueError, match=f"learn: {LAG} is chosen on flights of --source.*give --target"):
        prepare(config, Console(quiet=True))


@pytest.mark.parametrize("learned", [True, False])
def test_rotor_lag_is_applied_once(learned, tmp_path):
    vehicle = with_lag(tmp_path)
    if not learned:
        vehicle.write_text(vehicle.read_text().replace(f', "{LAG}"', ""))
    folders = {"source": write(tmp_path / "source", LOGS[:2]), "target": write(tmp_path / "target", OTHERS[:1])}
    experiment = prepare(replace(CONFIG, vehicle=vehicle, cache=tmp_path, **folders), Console(quiet=True))
    lines = [line for logs in experiment.logs.values() for record in logs.records for line in record["done"]]
    assert len(lines) == 3
    assert len(set(lines)) == 1
    assert (lines[0] == "rotors follow the log's motors with a time constant of 30.0 ms") == (not learned)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [([], "no logs at hand?"), (["--activation", "sigmoid"], "'sigmoid' for argument '--activation'")],
)
def test_guide_is_printed_without_flights_but_a_wrong_option_is_named_first(arguments, message, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err.lower()


def test_lists_may_be_comma_separated():
    given = ["--n", "100,300", "--horizon=10,50", "--source", "1,2", "--test=3,4", "--learn", "Ix,Iy", "k", "--refit"]
    given += ["--motor-order", "2,0,3,1", "--topics", "imu=/imu,motors=/m:data:rpm"]
    given += ["--polynomial", "-150.5,9e2", "--models=hybrid", "--recipes", "staged,turning", "--epochs", "0.5"]
    expected = ["--n", "100", "300", "--horizon", "10", "50", "--source", "1,2", "--test=3,4"]
    expected += ["--learn", "Ix", "Iy", "k", "--refit", "--motor-order", "2", "0", "3", "1"]
    expected += ["--topics", "imu=/imu", "motors=/m:data:rpm", "--polynomial", "-150.5", "9e2", "--models", "hybrid"]
    expected += ["--recipes", "staged", "turning", "--epochs", "0.5"]
    assert split_lists(given, LISTS) == expected
    config = read("real_flight", "", expected, PRESETS)
    assert (config.polynomial, config.learn, config.test) == ((-150.5, 900.0), ("Ix", "Iy", "k"), Path("3,4"))
    several = {f"--{each.name.replace('_', '-')}" for each in fields(RealFlightConfig) if "tuple" in str(each.type)}
    assert several == set(LISTS)


def test_learn_option_overrides_the_vehicle_file(vehicle, tmp_path):
    config = replace(CONFIG, learn=("Ix", LAG))
    *models, chooses_lag, not_learned = load_vehicle_models(vehicle, config)
    assert (chooses_lag, not_learned) == (True, "")
    assert [model.learn for model in models] == [("Ix",)] * 2
    assert not load_vehicle_models(with_lag(tmp_path), replace(config, learn=("Ix",)))[2]
    with pytest.raises(ValueError, match="must not name a parameter twice"):
        replace(config, learn=(LAG, LAG))


def test_a_term_without_a_purpose_is_not_learned(vehicle):
    before, after, _, line = load_vehicle_models(vehicle, CONFIG)
    assert "cable_pull" not in (*before.learn, *after.learn)
    assert "cable_pull is not learned, as the file does not say what it is for" in line
    vehicle.write_text('purpose = { cable_pull = "a load on a cable" }\n' + vehicle_toml(IRIS))
    before, after, _, line = load_vehicle_models(vehicle, CONFIG)
    assert ("cable_pull" in before.learn, line) == (True, "")
    vehicle.write_text("purpose = { wings = 'lift' }\n" + vehicle_toml(IRIS))
    with pytest.raises(ValueError, match="learn must be names of"):
        load_vehicle_models(vehicle, CONFIG)


def test_a_failed_check_stops_before_training_and_says_what_to_type(vehicle, tmp_path):
    """A motor beyond its limit: refused before training, or overridden."""
    source = write(tmp_path / "source", [replace(log, u=np.add(log.u, [0, 0, 900, 0])) for log in LOGS[:3]])
    (source / "notes.txt").write_text("windy")
    config = replace(CONFIG, vehicle=vehicle, source=source, cache=tmp_path)
    with pytest.raises(ChecksFailed) as stop:
        prepare(config, Console(quiet=True))
    assert "source/chirp_run1.csv.gz: motors within limits: rotor_speed of motor 2" in stop.value.args[0]
    assert "--anyway" in stop.value.args[-1]
    found = prepare(replace(config, anyway=True), Console(quiet=True)).logs["source"]
    assert (found.left, found.records[0]["fails"] > 0) == ({"notes.txt": "no format that is read"}, True)


@pytest.mark.slow
def test_failed_checks_end_with_exit_code_3(vehicle, tmp_path):
    source = write(tmp_path / "source", [replace(log, u=log.u + 900) for log in LOGS[:3]])
    run = command("real_flight", "--vehicle", str(vehicle), "--source", str(source), folder=tmp_path)
    assert run.returncode == FAILED_CHECKS
    assert "motors within limits" in run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.slow
def test_bad_log_is_refused_with_file_row_and_field(vehicle, tmp_path):
    source = write(tmp_path / "source", LOGS[:3])
    rows = ("0,0,0,1,1,0,0,0,0,0,0,0,0,0,600,600,600,600", "0.01,0,0,1,1,0,0,0,fast,0,0,0,0,0,600,600,600,600")
    (source / "bad.csv").write_text("\n".join(["t,px,py,pz,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,u0,u1,u2,u3", *rows]))
    options = ("--vehicle", str(vehicle), "--source", str(source))
    line = refused(command("real_flight", *options, folder=tmp_path), "real_flight")
    assert line.startswith(f"real_flight: {source / 'bad.csv'}: row 3, field vx: ")
    left = (tmp_path / "out" / "real_flight").iterdir()
    assert [path.name for path in left] == [".lock"]  # no partial results


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated")
    (run,) = experiments("real_flight", "real_flight", folder=folder, options=("--simulated",))
    assert run.returncode == 0, run.stderr
    return folder / "out" / "real_flight", run


@pytest.mark.slow
def test_simulated_run_writes_a_complete_report(simulated):
    out, run = simulated
    report = json.loads((out / "report.json").read_text())
    assert {"versions", "hardware", "seconds"} <= set(report["environment"])
    assert report["config"]["preset"] == "smoke"
    # Two folds: hold, thrust, two linear residuals; three models zero-shot and fine-tuned, the hybrid from scratch; the
    # chosen one.
    assert len(report["rows"]) == 2 * (4 + 3 * 2 + 1 + 1)
    for found in report["rows"]:
        assert set(found["scores"]) == {"5", "10"}
        assert all(set(errors) == set(QUANTITIES) for errors in found["scores"].values())
        assert (found["theta"] is None) == (found["model"] not in ("hybrid", "physics_only"))
    for fold in report["folds"]:
        assert not set(fold["test"]) & {*fold["train"], *fold["validation"]}
    assert sum(map(len, report["logs"].values())) == 16
    for fold, selected in zip(report["folds"], report["selections"], strict=True):
        assert sorted(selected["left_out"]) == sorted([*fold["train"], *fold["validation"]])
        assert set(selected["observed"]) == set(fold["test"]) <= set(report["outside"])
        (chosen,) = (r for r in report["rows"] if (r["model"], r["fold"]) == ("chosen", fold["tested_on"]))
        assert chosen["recipe"] == selected["chosen"] in selected["scores"]
    page = (out / "report.md").read_text()
    parts = "Error to expect", "Checks: of each log", "Test flights against", "RMSE at step"
    assert sorted(parts, key=page.index) == [*parts]
    for figure in report["figures"]:
        assert (out / figure).read_bytes().startswith(b"\x89PNG")
        assert f"({figure})" in page
    assert "Traceback" not in run.stderr


@pytest.mark.slow
def test_adaptation_changes_all_parameters(simulated):
    rows = json.loads((simulated[0] / "report.json").read_text())["rows"]
    theta = {(row["fold"], row["model"], row["mode"]): row["theta"] for row in rows}
    for (fold, model, mode), adapted in theta.items():
        if mode == "fine_tuned" and adapted:
            source = theta[fold, model, "zero_shot"]
            assert not {name for name, value in adapted.items() if value == source[name]}
            assert all(value != 0.0 for value in source.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hybrid", "no_physics", "physics_only", "chosen"])
def test_saved_models_load_and_predict(simulated, name):
    path = simulated[0] / "models" / f"fold0-{name}-fine_tuned-20-seed0.npz"
    code = f"""
import hybrid_jax, numpy as np
model = hybrid_jax.load({str(path)!r})
x0 = np.array([0, 0, 2, 1, *[0] * 9], np.float32)
assert model.about["dt"] == {DT}
assert np.isfinite(model.predict(x0, np.full((5, 4), 600, np.float32), {DT})).all()
"""
    script("-c", code)
