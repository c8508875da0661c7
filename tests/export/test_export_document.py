"""What docs/howto/c.md and export.md show is what happens; a program carries the state of a model with a past."""

import re
from contextlib import nullcontext
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import C99, Library, needs_compiler, run
from fields import KEY
from smoke import ROOT, script
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.cli import main
from hybrid_jax.dynamics.hidden import DisturbanceModel
from hybrid_jax.export import casadi_function, export_c, export_program, load_program


def programs(page, language="python"):
    text = (ROOT / "docs" / "howto" / page).read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def said(code, folder):
    return script("-c", f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{code}", cwd=folder)


@pytest.mark.slow
def test_the_examples_run_and_the_two_forms_agree(tmp_path):
    with_library, without = programs("export.md")
    of_the_first = said(with_library, tmp_path)
    assert "F:(x[13],u[4])->(xnext[13])" in of_the_first
    assert float(of_the_first.split()[-1]) < 1e-5  # single precision of states of size 1
    assert (tmp_path / "step.casadi").exists()
    assert "float32[13]" in said(f"sys.modules['hybrid_jax'] = None\n{without}", tmp_path)


@needs_compiler
def test_the_program_in_c_runs_and_says_what_jax_says(tmp_path, monkeypatch):
    (program,) = (one for one in programs("c.md", "c") if one.startswith("#include"))
    body = hj.rigid_body(hj.IRIS)
    hj.save(tmp_path / "model.npz", body, {"dt": 0.01})
    folders = ["-o", tmp_path / "board", "--out", tmp_path]
    for name in ("command.configure", "answering"):  # devices and signals are those of this process
        monkeypatch.setattr(f"hybrid_jax.cli.{name}", lambda *_, **__: nullcontext())
    with pytest.raises(SystemExit, match="0"):
        main([*map(str, ("export", tmp_path / "model.npz", "--name", "iris", *folders))])
    (tmp_path / "main.c").write_text(program)
    sources = "main.c", "board/iris.c"
    run("gcc", *C99, "-O2", "-Iboard", *sources, "-lm", "-o", "program", cwd=tmp_path)
    printed = run(tmp_path / "program")

    speeds = np.repeat([[650.0], [660.0], [660.0]], 4, axis=1)
    x0 = np.array([0, 0, 1, 1] + [0] * 9, float)
    expected = float(hj.rollout(body, x0, speeds, 0.01)[-1, 9])
    assert float(re.search(r"after 30 ms: vz = (\S+)", printed)[1]) == np.float64(f"{expected:.4f}")
    # dv/du = 2 k u dt / m
    push = 2 * hj.IRIS.thrust_coefficient * 660 * 0.01 / hj.IRIS.mass
    assert abs(float(re.search(r"adds (\S+)", printed)[1]) - 10 * push) < 1e-3 * 10 * push + 5e-6


DT, SEEN, AHEAD = 0.01, 30, 10
BODY = hj.Hybrid(hj.rigid_body(hj.IRIS), hj.residual_network(13, 4, KEY, hidden=4))
WEIGHTS = jnp.asarray(np.random.default_rng(1).normal(0, 0.1, (12, 12 * 2 + 6 + 1)), jnp.float32)
MODEL = DisturbanceModel(BODY, WEIGHTS, jnp.ones(31), (0.05, 0.2), tuple(range(7, 13)))


def flight():
    """One whose errors are not zero: sensors with noise see it."""
    random = np.random.default_rng(0)
    x0 = np.eye(13, dtype="f4")[3:4]
    u = (hj.IRIS.hover_speed * (1 + 0.02 * random.normal(size=(1, SEEN + AHEAD, 4)))).astype("f4")
    x = np.array(hj.rollout_batch(hj.rigid_body(hj.IRIS), x0, u, DT))
    x[..., 7:] += 0.02 * random.normal(size=x[..., 7:].shape)
    return hj.Trajectories(x0, u, x, DT)


def in_c(folder):
    library = Library(export_c(folder, MODEL, DT)[1], (37, 4), double=False)
    return partial(library, "observe"), partial(library, "step")


def in_casadi(folder):
    pytest.importorskip("casadi")
    programs = (casadi_function(MODEL, DT, observe=observe) for observe in (True, False))
    return [lambda *given, one=one: one(*given).full()[:, 0] for one in programs]


def in_a_file(folder):
    for name, observe in (("observe", True), ("step", False)):
        export_program(folder / name, MODEL, DT, observe=observe)
    return load_program(folder / "observe"), load_program(folder / "step")


@pytest.mark.parametrize("exported", [pytest.param(in_c, marks=needs_compiler), in_casadi, in_a_file])
def test_a_state_that_is_carried_predicts_as_the_model_from_its_past(exported, tmp_path):
    flown, (observe, step) = flight(), exported(tmp_path)
    state = np.concatenate([flown.x0[0], np.zeros(MODEL.hidden)])
    for u, measured in zip(flown.u[0, :SEEN], flown.x[0, :SEEN], strict=True):
        state = observe(state, u, measured)
    past = jax.tree.map(lambda part: part if part.ndim == 2 else part[:, :SEEN], flown)
    begun = hj.observe(MODEL, past)[:, -1]
    np.testing.assert_allclose(state, begun[0], atol=2e-4)
    assert np.abs(begun[0, 13:]).max() > 1
    for u in flown.u[0, SEEN:]:
        state = step(state, u)
    expected = hj.rollout_batch(MODEL, begun, flown.u[:, SEEN:], DT)[0, -1]
    np.testing.assert_allclose(state, expected, rtol=1e-4, atol=2e-3)


def test_only_a_model_with_a_past_observes_and_other_hidden_states_are_carried_by_the_caller(tmp_path):
    refusal(lambda: casadi_function(BODY, DT, observe=True), "observe: needs a field that `fit_disturbance` returned")
    refusal(lambda: casadi_function(MODEL, observe=True), "dt must be")
    export_program(tmp_path / "p", MODEL, DT, observe=True)
    refusal(lambda: load_program(tmp_path / "p")(np.ones(37), np.ones(4)), "measured (13,) expected")
    lag = hj.dynamics.Lag(jnp.log(jnp.full(4, 0.05)), (0, 1, 2, 3))
    assert str(casadi_function(hj.with_hidden(BODY, lag), DT)) == "f:(x[17],u[4])->(xnext[17]) SXFunction"
