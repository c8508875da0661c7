"""Training and held-out flights are disjoint."""

from dataclasses import replace

import pytest
from recorded import LOGS
from surface import refusal

from hybrid_jax.flights.windows import flight_of, folds, hold_out, manoeuvre_of


@pytest.mark.parametrize(
    ("name", "own", "manoeuvre"),
    [
        ("/a/b/chirp_run2.csv.gz", "chirp_run2", "chirp"),
        ("melon-03.csv", "melon-03", "melon"),
        ("flight_17.csv", "flight_17", "flight_17"),
        ("figure8_run2.ULG", "figure8_run2", "figure8"),
        ("squarerun3.csv", "squarerun3", "square"),
        ("hover flight-4.csv", "hover flight-4", "hover"),
        ("2024.05.01_hover_2.Csv.Gz", "2024.05.01_hover_2", "2024.05.01_hover"),
        ("17.csv", "17", "17"),
    ],
)
def test_names_of_flights_and_manoeuvres(name, own, manoeuvre):
    log = replace(LOGS[0], name=name)
    assert (flight_of(log), manoeuvre_of(log)) == (own, manoeuvre)


@pytest.mark.parametrize("of", [flight_of, manoeuvre_of])
@pytest.mark.parametrize("count", [None, 2])
def test_folds_hold_out_every_flight_once(of, count):
    found = folds(LOGS, count, of)
    assert len(found) == (count or len({of(log) for log in LOGS}))
    held = [log.name for _, out in found for log in out]
    assert sorted(held) == sorted(log.name for log in LOGS)
    for kept, out in found:
        assert not {of(log) for log in kept} & {of(log) for log in out}
        assert len(kept) + len(out) == len(LOGS)


def test_a_manoeuvre_is_held_out_whole():
    kept, out = hold_out(LOGS, ["random"], manoeuvre_of)
    assert [flight_of(log) for log in out] == ["random_run1", "random_run2", "random_run3"]
    assert len(kept) == 6


def test_impossible_splits_are_refused():
    refusal(lambda: hold_out(LOGS, ["melon"], manoeuvre_of), "'melon'", "chirp")
    refusal(lambda: hold_out(LOGS[:1], ["chirp_run1"]), "0 flights for training")
    refusal(lambda: folds(LOGS, 4, manoeuvre_of), "3 different names")
