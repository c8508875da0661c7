"""`python -m experiments.export`: a model's file becomes programs, or the command says in one line why not."""

import jax
import numpy as np
import pytest

import hybrid_jax as hj
from experiments import export as command
from hybrid_jax.export import load_program

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


@pytest.mark.parametrize(
    ("about", "options", "message"),
    [
        ({"dt": 0.02}, ["--state-size", "12"], "field: Hybrid does not take"),
        *(
            ({"dt": 0.02}, ["--dt", dt], f"--dt must be a positive number of seconds, got {dt}")
            for dt in ("-0.01", "0", "nan")
        ),
        ({}, [], "--dt is needed"),
    ],
    ids=str,
)
def test_bad_input_ends_in_one_line(about, options, message, field, tmp_path, capsys):
    hj.save(tmp_path / "model.npz", field, about)
    with pytest.raises(SystemExit, match="2"):
        command.main([str(tmp_path / "model.npz"), "--out", str(tmp_path / "out"), *options])
    printed = capsys.readouterr().err
    assert printed.startswith("export: ")
    assert message in printed
    assert printed.count("\n") == 1
    assert not list(tmp_path.glob("out/*"))  # nothing is written half
