"""`hybrid-jax export`: a model's file becomes programs, or the command says in one line why not."""

import json
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from hybrid_jax.cli.export import TORQUE, Options, _filter
from hybrid_jax.dynamics.hidden import DisturbanceModel
from hybrid_jax.dynamics.rigid_body import Kinematics
from hybrid_jax.export import load_program
from hybrid_jax.networks.standardise import with_motion

ca = pytest.importorskip("casadi")
X, U = np.array([0, 0, 1, 1.0, 0, 0, 0, 0.3, 0, 0, 0, 0, 0.1]), np.full(4, 650.0)


@pytest.fixture(scope="module")
def field():
    return hj.Hybrid(hj.rigid_body(hj.IRIS), hj.residual_network(13, 4, jax.random.key(0), hidden=4))


@pytest.fixture
def filters(monkeypatch):
    """The filters that the command would write as C, with their options; to translate one takes seconds."""
    given = []
    name = "hybrid_jax.cli.export.export_adaptation_c"
    monkeypatch.setattr(name, lambda *each, **own: given.append((*each, own)) or [])
    return given


def test_all_that_is_written_is_the_model(field, tmp_path, called):
    model, out = tmp_path / "model.npz", tmp_path / "files"
    hj.save(model, field, {"seed": 3, "dt": 0.02})
    called("export", model, "-o", out, "--to", "casadi,stablehlo", "--out", tmp_path)
    names = ["field.npz", "field.casadi", "step.npz", "step.casadi"]
    assert json.loads((tmp_path / "report.json").read_text())["files"] == [str(out / name) for name in names]
    step, field = load_program(out / "step.npz"), load_program(out / "field.npz")
    assert (step.dt, step.about["seed"], field.dt) == (0.02, 3, None)
    predicted = hj.load(model).predict(X, U[None], 0.02)[0]
    np.testing.assert_allclose(step(X, U), predicted, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(ca.Function.load(str(out / "step.casadi"))(X, U).full()[:, 0], predicted, atol=1e-5)
    derivative = ca.Function.load(str(out / "field.casadi"))(X, U).full()[:, 0]
    np.testing.assert_allclose(field(X, U), derivative, rtol=1e-5, atol=1e-4)


def test_of_a_model_with_a_past_the_update_is_written_and_a_filter_keeps_its_disturbance(tmp_path, called, filters):
    model = DisturbanceModel(hj.rigid_body(hj.IRIS), jnp.eye(12, 13), jnp.ones(13), (0.1,), ())
    hj.save(tmp_path / "model.npz", model, {"dt": 0.02})
    _, said, _ = called("export", tmp_path / "model.npz", "-o", tmp_path, "--to", "c,stablehlo", "--out", tmp_path)
    assert "Its state ends with 12 filtered errors, which are 0 at first" in said
    assert "adapts Ix, Iy, k, disturbance, of the model without its past, with" in said
    x0 = np.concatenate([X, np.zeros(12)])
    seen = load_program(tmp_path / "observe.npz")(x0, U, X)
    np.testing.assert_allclose(seen, model.after(x0, hj.rollout(model.field, X, U[None], 0.02)[0], X, 0.02), atol=1e-3)
    assert "void model_observe(" in (tmp_path / "model.h").read_text()
    assert len(filters) == 1
    # Of a model with a torque alone the exported filter had six disturbances for three.
    body = hj.with_disturbance(hj.rigid_body(hj.IRIS), (10, 11, 12))
    made = _filter(Options(tmp_path, tmp_path), body, 0.01, 13)
    assert isinstance(made, hj.OnlineAdaptation)
    scales = dict(zip(made.names, made.scales, strict=True))
    assert [size for name, size in scales.items() if name.startswith("disturbance")] == [TORQUE] * 3


def test_c_is_written_and_how_much_smoothing_changes_is_said(field, tmp_path, called, monkeypatch, filters):
    monkeypatch.chdir(tmp_path)
    x0, u = np.tile(X, (20, 1)), np.full((20, 10, 4), 650.0)
    motion = hj.Trajectories(x0, u, np.tile(x0[:, None], (1, 10, 1)), 0.02)
    hj.save("model.npz", with_motion(field, motion), {"dt": 0.02})
    _, said, _ = called("export", "model.npz", "-o", "board", "--name", "iris", "--double", "--smooth", "30")
    assert {path.name for path in (tmp_path / "board").iterdir()} == {"iris.h", "iris.c"}
    assert (filters[0][0].name, filters[0][-1]["name"], filters[0][-1]["double"]) == ("board", "iris_adaptation", True)
    assert "IRIS_DT 0.02" in (tmp_path / "board" / "iris.h").read_text()
    assert "typedef double real" in (tmp_path / "board" / "iris.c").read_text()
    (found,) = map(float, re.findall(r"smooth 30, ẋ changes by at most ([\d.e-]+),", said))
    assert 0 < found <= np.abs(field.residual.weight_out).sum(axis=1).max() / 60


def test_the_filter_that_is_written_is_that_of_the_options_and_none_without_a_parameter(tmp_path, called, filters):
    hj.save(tmp_path / "model.npz", hj.rigid_body(hj.IRIS), {"dt": 0.02})
    options = "--noise-std 0.1,0.2,0.3,0.4"
    _, said, _ = called("export", tmp_path / "model.npz", "-o", tmp_path, "--out", tmp_path, *options.split())
    assert "model_adaptation adapts Ix, Iy, k, disturbance, with a sample every 0.02 s" in said
    noise, process = (np.repeat(each, [3, 4, 3, 3]) for each in ([0.1, 0.2, 0.3, 0.4], [0, 0, 0.003, 0.005]))
    pushed = (3, 3, 3, 5, 5, 5)
    wanted = hj.OnlineAdaptation(hj.rigid_body(hj.IRIS), 0.02, noise, disturbance=pushed, process=process)
    assert eqx.tree_equal(filters[0][1], wanted)
    assert filters[0][-1] == {"name": "model_adaptation", "double": False, "state_size": 13, "input_size": 4}
    hj.save(tmp_path / "model.npz", Kinematics(), {"dt": 0.02})
    sizes = ["--state-size", "13", "--input-size", "4"]
    _, said, _ = called("export", tmp_path / "model.npz", "-o", tmp_path, "--out", tmp_path, *sizes)
    assert "No filter is written: field: its physics, Kinematics, has no parameter" in said


@pytest.mark.parametrize(
    ("about", "options", "message"),
    [
        ({"dt": 0.02}, ["--state-size", "12"], "field: RigidBody does not accept"),
        ({"dt": 0.02}, ["--dt", "nan"], "--dt must be a positive number of seconds, got nan"),
        ({}, [], "--dt is needed"), ({"dt": 0.02}, ["--smooth", "-1"], "--smooth must be"),
        ({"dt": 0.02}, ["--name", "1"], "name must be a lower-case C identifier"),
        ({"dt": 0.02}, ["--noise-std", "1", "--to", "casadi"], "needs --to c"),
        ({"dt": 0.02}, ["--noise-std", "1", "2"], "--noise-std must be 1, 4 or 13 numbers, got 2"),
    ],
    ids=str,
)  # fmt: skip
def test_bad_input_ends_in_one_line(about, options, message, field, tmp_path, called, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hj.save("model.npz", field, about)
    code, _, printed = called("export", "model.npz", "-o", "files", *options)
    assert code == 2
    assert message in printed.splitlines()[-1]
    assert [path.name for path in tmp_path.iterdir()] == ["model.npz"]  # nothing is written half
