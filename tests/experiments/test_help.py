"""Commands that reproduce one result have a command line like all others."""

from importlib import import_module

import pytest


@pytest.mark.parametrize("name", ["identification.crazypad", "identification.nanobench"])
@pytest.mark.parametrize(
    ("arguments", "code"), [(["--help"], 0), ([], 2), (["none", "more"], 2), (["none"], 2)], ids=str
)
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
