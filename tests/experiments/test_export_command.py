"""`python -m experiments.export`: a model's file becomes programs, or the command says in one line why not."""

import re

import jax
import numpy as np
import pytest

import hybrid_jax as hj
from experiments import export as command
from hybrid_jax.dynamics.baselines import Kinematics
from hybrid_jax.export import export_adaptation_c, load_program
from hybrid_jax.io.datasets import Dataset, save_dataset

ca = pytest.importorskip("casadi")
X, U = np.array([0, 0, 1, 1.0, 0, 0, 0, 0.3, 0, 0, 0, 0, 0.1]), np.full(4, 650.0)


@pytest.fixture(scope="module")
def field():
    return hj.Hybrid(hj.rigid_body(hj.IRIS), hj.residual_network(13, 4, jax.random.key(0), hidden=4))


def test_all_that_is_written_is_the_model(field, tmp_path, capsys):
    model, out = tmp_path / "model.npz", tmp_path / "out"
    hj.save(model, field, {"seed": 3, "dt": 0.02})
    command.main([str(model), "--out", str(out), "--casadi"])
    names = ["field.npz", "step.npz", "field.casadi", "step.casadi"]
    assert capsys.readouterr().out.split() == [str(out / name) for name in names]
    step, field = load_program(out / "step.npz"), load_program(out / "field.npz")
    assert (step.dt, step.about["seed"], field.dt) == (0.02, 3, None)
    predicted = hj.load(model).predict(X, U[None], 0.02)[0]
    np.testing.assert_allclose(step(X, U), predicted, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(ca.Function.load(str(out / "step.casadi"))(X, U).full()[:, 0], predicted, atol=1e-5)
    derivative = ca.Function.load(str(out / "field.casadi"))(X, U).full()[:, 0]
    np.testing.assert_allclose(field(X, U), derivative, rtol=1e-5, atol=1e-4)


def test_c_alone_is_written_and_how_much_smoothing_changes_is_said(field, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hj.save("model.npz", field, {"dt": 0.02})
    command.main(["model.npz", "--c", "board", "--name", "iris", "--double", "--smooth", "30"])
    *written, said, _ = capsys.readouterr().out.splitlines()
    assert written == [f"board/{name}" for name in ("iris.h", "iris.c", "iris_adaptation.h", "iris_adaptation.c")]
    assert "IRIS_DT 0.02" in (tmp_path / "board" / "iris.h").read_text()
    assert "typedef double real" in (tmp_path / "board" / "iris.c").read_text()
    found = float(re.search(r"smooth 30: ẋ differs by at most ([\d.e-]+)", said)[1])
    assert 0 < found <= np.abs(field.residual.weight_out).sum(axis=1).max() / 60
    assert not (tmp_path / "runs").exists()


def test_smoothing_is_looked_at_over_a_data_set(field, tmp_path, capsys):
    model, data = tmp_path / "model.npz", tmp_path / "data.npz"
    hj.save(model, field, {"dt": 0.02})
    windows = hj.Trajectories(np.tile(X, (3, 1)), np.tile(U, (3, 2, 1)), np.tile(X, (3, 2, 1)), 0.02)
    save_dataset(data, Dataset({"train": windows}, {}))
    command.main([str(model), "--c", str(tmp_path), "--smooth", "30", "--data", str(data)])
    assert capsys.readouterr().out.splitlines()[-2].endswith(f"3 of {data}")


def test_the_filter_that_is_written_is_that_of_the_options(tmp_path, capsys):
    hj.save(tmp_path / "model.npz", hj.rigid_body(hj.IRIS), {"dt": 0.02})
    options = "--period 0.01 --noise 0.1 0.2 0.3 0.4 --process 0.5 --prior Ix=0.6 --disturbance 0".replace(
        "--", "--adaptation."
    )
    command.main([str(tmp_path / "model.npz"), "--c", str(tmp_path), "--double", *options.split()])
    assert capsys.readouterr().out.endswith("model_adaptation adapts Ix, Iy, k, with a sample every 0.01 s\n")
    noise, prior = np.repeat([0.1, 0.2, 0.3, 0.4], [3, 4, 3, 3]), {"Ix": 0.6, "Iy": 0.3, "k": 0.3}
    wanted = hj.OnlineAdaptation(hj.rigid_body(hj.IRIS), 0.01, noise, prior, process=0.5)
    for path in export_adaptation_c(tmp_path / "wanted", wanted, name="model_adaptation", double=True):
        assert (tmp_path / path.name).read_text() == path.read_text()


def test_a_model_without_parameters_has_no_filter(tmp_path, capsys):
    hj.save(tmp_path / "model.npz", Kinematics(), {"dt": 0.02})
    command.main([str(tmp_path / "model.npz"), "--c", str(tmp_path), "--input-size", "4"])
    assert "no filter is written: field: its physics, Kinematics, has no parameter" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("about", "options", "message"),
    [
        ({"dt": 0.02}, ["--state-size", "12"], "field: RigidBody does not take"),
        *(
            ({"dt": 0.02}, ["--dt", dt], f"--dt must be a positive number of seconds, got {dt}")
            for dt in ("-0.01", "0", "nan")
        ),
        ({}, [], "--dt is needed"),
        ({"dt": 0.02}, ["--smooth", "-1"], "--smooth must be"),
        ({"dt": 0.02}, ["--c", "c", "--name", "1"], "name must be a lower-case C identifier"),
        ({"dt": 0.02}, ["--adaptation.period", "1"], "--adaptation needs --c"),
        *(
            ({"dt": 0.02}, ["--c", "c", f"--adaptation.{option}", *words], message)
            for option, words, message in (
                ("noise", ["1", "2"], "--adaptation.noise must be 1, 4 or 13 numbers, got 2"),
                ("noise", ["0"], "--adaptation.noise must be a positive finite number, got 0"),
                ("disturbance", ["1", "2"], "--adaptation.disturbance must be 1 or 6 numbers, got 2"),
                ("prior", ["Ix"], "--adaptation.prior must be a number, or words such as Ix=0.3, got Ix"),
                ("prior", ["m=1"], "prior: m: must be among Ix, Iy, k"),
            )
        ),
    ],
    ids=str,
)
def test_bad_input_ends_in_one_line(about, options, message, field, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hj.save(tmp_path / "model.npz", field, about)
    with pytest.raises(SystemExit, match="2"):
        command.main([str(tmp_path / "model.npz"), "--out", str(tmp_path / "out"), *options])
    printed = capsys.readouterr().err
    assert printed.startswith("export: ")
    assert message in printed
    assert printed.count("\n") == 1
    assert not [*tmp_path.glob("out/*"), *tmp_path.glob("c/*")]  # nothing is written half
