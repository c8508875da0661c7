"""Help of all programs; a public record is fitted, and a wrong one refused in a line."""

import csv
import dataclasses
from importlib import import_module

import numpy as np
import pytest

import hybrid_jax as hj
from experiments.identification import emps, record, tanks


@pytest.mark.parametrize("name", ["identification.crazypad", "identification.nanobench"])
@pytest.mark.parametrize(("arguments", "code"), [(["--help"], 0), ([], 2), (["none"], 2)], ids=str)
def test_the_command_line_is_explained_or_refused_in_one_line(name, arguments, code, monkeypatch, capsys):
    """--help was taken for a folder, and without an argument there was a traceback."""
    monkeypatch.setattr("hybrid_jax.runtime.configure", lambda: None)  # JAX has begun in this process
    with pytest.raises(SystemExit) as stop:
        import_module(f"experiments.{name}").main(arguments)
    assert stop.value.code == code
    said = capsys.readouterr()
    assert f"usage: python -m experiments.{name}" in said.out if code == 0 else said.err.startswith(f"{name}: ")
    assert len(said.err.splitlines()) == (code != 0)


MAIN = {
    name: f"experiments.{name}.__main__"
    for name in ("closed_loop", "excitation", "online", "reaction_diffusion", "real_flight", "worlds")
}
NAMES = "ablation changes closed_loop comparison coverage excitation external_force online param_shift worlds"


@pytest.mark.parametrize("name", [*NAMES.split(), "reaction_diffusion", "real_flight", "make_flights"])
def test_help_has_a_screen_of_options_for_users(name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as stop:
        import_module(MAIN.get(name, f"experiments.{name}")).main(["--help"])
    said = capsys.readouterr().out.splitlines()
    assert stop.value.code == 0
    assert 4 <= sum(line.startswith("  --") for line in said) <= 12
    assert len(said) <= 50
    assert max(map(len, said)) <= 80


def write(path, columns, t, u, y):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("t", *columns), *zip(t, u, y, strict=True)])
    return str(path)


@pytest.fixture(scope="module")
def slide(tmp_path_factory):
    """Two records of a slide that is pushed to and fro."""
    paths = []
    for name, phase in (("one", 0.0), ("two", 1.0)):
        t = np.arange(0, 6, 0.01)
        u = 90 * np.sin(2 * t + phase) + 40 * np.sin(5.3 * t)
        model, _ = emps.candidate()
        made = hj.Record.of(name, u=(t, u), q=(t, 0 * t))
        q = hj.simulate(model, made, (0.0, 0.0), dt=0.01, between="linear", substeps=2)[0]["q"][:, 0]
        path = tmp_path_factory.mktemp("slide") / f"{name}.csv"
        paths.append(write(path, ("u", "q"), t, u, q + 1e-4 * np.random.default_rng(0).normal(size=len(t))))
    return paths


@pytest.mark.slow
def test_the_model_that_made_a_record_predicts_another(slide, capsys):
    one = dataclasses.replace(emps.BENCHMARK, candidates={"physics": emps.candidate}, parts=2)
    record.main(one, "identification.emps", [slide[0], "--test", slide[1]])
    said = capsys.readouterr().out
    assert "Chosen: physics" in said
    assert float(said.split("two.csv: ")[1].split(" mm")[0]) < 2.0


def test_what_is_added_to_the_physics_is_zero_at_first():
    x, u = np.array([4.0, 6.0, 0.0]), np.array([3.0])
    models = [make()[0] for make in tanks.BENCHMARK.candidates.values()]
    plain, *others = (model.field(x[: model.size], u)[:2] for model in models)
    np.testing.assert_allclose(others, [plain] * 2, rtol=1e-6)


def test_a_sensor_with_play_stays_at_a_reversal_and_then_follows():
    field, play = tanks.physics("log_play"), 0.15
    rate = field(np.array([4.0, 6.0, 0.0]), np.array([3.0]))[1]
    for z, share in ((0.0, 1.0), (-np.sign(rate) * play, 1.0), (np.sign(rate) * play, 0.0)):
        change = field(np.array([4.0, 6.0, z]), np.array([3.0]))
        np.testing.assert_allclose(change[2], share * change[1], atol=1e-7)


@pytest.mark.parametrize(
    ("header", "row", "said"),
    [
        (("t", "u", "y"), (0, 1, 2), "has no column q; it has t, u, y"),
        (("t", "u", "q"), (0, "x", 2), "row 2: three numbers expected"),
    ],
)
def test_a_wrong_record_is_refused_in_a_line(tmp_path, header, row, said, capsys):
    path = tmp_path / "wrong.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, row])
    with pytest.raises(SystemExit) as ended:
        record.main(emps.BENCHMARK, "identification.emps", [str(path)])
    assert ended.value.code == 2
    assert said in " ".join(capsys.readouterr().err.split())
