"""An unfinished run goes on as itself or not at all; nothing of it is deleted. Old option names are accepted."""

import json
from dataclasses import replace

import pytest

from experiments.paper.config import SMOKE
from experiments.runner.run_record import FILE, OtherRun, recorded
from hybrid_jax import kernels
from hybrid_jax.cli.command import ChecksFailed
from hybrid_jax.kernels.library import SWITCH, obstacle


def record(folder):
    return json.loads((folder / FILE).read_text())


def finish(folder, config, say=print):
    with recorded(folder, config, say):
        assert record(folder)["state"] == "unfinished"
    assert record(folder)["state"] == "finished"


def interrupt(folder, config, error=KeyboardInterrupt):
    with pytest.raises(error), recorded(folder, config, print):
        raise error


def test_a_finished_run_gives_way_to_any_other_and_an_unfinished_one_goes_on_and_says_so(tmp_path):
    finish(tmp_path, replace(SMOKE, seeds=2))
    interrupt(tmp_path, SMOKE)
    begun, said = record(tmp_path), []
    finish(tmp_path, replace(SMOKE, saving=0.5, cache=tmp_path), said.append)
    assert said == [f"{tmp_path}: goes on with the run begun {begun['started']}"]
    assert record(tmp_path) == begun | {"state": "finished"}


def test_another_configuration_is_refused_field_by_field(tmp_path):
    interrupt(tmp_path, SMOKE)
    before = record(tmp_path)
    other = replace(SMOKE, seeds=2, rates=replace(SMOKE.rates, physics=0.5))
    with pytest.raises(OtherRun) as refused:
        finish(tmp_path, other)
    assert str(refused.value).splitlines() == [
        f"{tmp_path}: holds an unfinished run, begun {before['started']}, that differs:",
        "  config.rates.physics: 0.01 → 0.5",
        "  config.seeds: 1 → 2",
        "  --restart starts from the beginning and renames it; another --out leaves it unchanged",
    ]
    assert record(tmp_path) == before


def test_flights_are_known_by_their_content(tmp_path):
    flights, out = tmp_path / "flights.npz", tmp_path / "out"
    flights.write_bytes(b"one")
    given = replace(SMOKE, source_flights=flights)
    interrupt(out, given)
    flights.rename(tmp_path / "moved.npz")
    interrupt(out, replace(SMOKE, source_flights=tmp_path / "moved.npz"))
    flights.write_bytes(b"two")
    with pytest.raises(OtherRun, match=r"flights\.source_flights: 7692c3ad\S+ → 3fc4ccfe\S+"):
        finish(out, given)


def test_fresh_moves_all_aside_but_the_lock(tmp_path):
    out = tmp_path / "out"
    interrupt(out, SMOKE)
    (out / ".lock").touch()
    (out / "models").mkdir()
    (out / "models" / "one.npz").write_bytes(b"mine")
    before = record(out)
    for count in (1, 2):
        interrupt(out, replace(SMOKE, seeds=2, fresh=True))
        assert len(list(tmp_path.glob("out.before-*"))) == count
        assert {path.name for path in out.iterdir()} == {".lock", FILE}
    first = min(tmp_path.glob("out.before-*"), key=lambda path: (len(path.name), path.name))
    assert record(first) == before
    assert (first / "models" / "one.npz").read_bytes() == b"mine"


@pytest.mark.parametrize("error", [ValueError, ChecksFailed])
def test_bad_input_begins_no_run_and_ends_none(tmp_path, error):
    interrupt(tmp_path, SMOKE, error)
    assert not (tmp_path / FILE).exists()
    interrupt(tmp_path, SMOKE, OSError)
    interrupt(tmp_path, SMOKE, error)
    assert record(tmp_path)["state"] == "unfinished"


@pytest.mark.parametrize("text", ["[]", "null", '{"state": "unfinished"}', "[" * 100_000, "{"])
def test_what_is_no_record_is_refused_in_a_line_and_kept(tmp_path, text):
    (tmp_path / FILE).write_text(text)
    with pytest.raises(ValueError, match=rf"{FILE}: (not the record of a run; --restart|truncated or not JSON)"):
        finish(tmp_path, SMOKE)
    assert (tmp_path / FILE).read_text() == text


def test_a_run_that_goes_on_with_other_cores_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.runner.run_record.cores", lambda: 2)
    interrupt(tmp_path, SMOKE)
    began, said = record(tmp_path)["machine"], []
    monkeypatch.setattr("experiments.runner.run_record.cores", lambda: 1)
    finish(tmp_path, SMOKE, said.append)
    assert said[1:] == ["machine.cores: 2 → 1: rows differ, if little, from those of a run on one machine"]
    assert record(tmp_path)["machine"] == began


def test_a_run_goes_on_with_jax_if_it_began_so_and_needs_the_kernels_it_began_with(tmp_path, monkeypatch):
    monkeypatch.setenv(SWITCH, "0")
    kernels.switch_off()
    interrupt(tmp_path, SMOKE)
    began, said = record(tmp_path), []
    monkeypatch.delenv(SWITCH)
    obstacle.cache_clear()
    interrupt(tmp_path, SMOKE)
    assert kernels.status() == began["machine"]["kernels"] == f"not used: {SWITCH} is 0"
    finish(tmp_path, SMOKE, said.append)
    assert (said[1:], record(tmp_path)["machine"]) == ([], began["machine"])
    monkeypatch.setattr("hybrid_jax.kernels.status", lambda: "used\nnot for Own: why")
    interrupt(tmp_path, SMOKE)
    monkeypatch.setattr("hybrid_jax.kernels.status", lambda: "not used: there is no g++")
    with pytest.raises(OtherRun, match=r"with kernels, which are now not used: there is no g\+\+\n  --restart"):
        finish(tmp_path, SMOKE)
    assert record(tmp_path)["state"] == "unfinished"
    obstacle.cache_clear()
