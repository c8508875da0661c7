"""A flight log is whole and possible, or refused with the first thing that is wrong."""

import numpy as np
import pytest
from surface import refusal

from hybrid_jax.flights.log import FlightLog


def test_quaternions_become_unit_and_continuous(flight):
    signs = np.where(np.arange(len(flight)) % 3 == 1, -1.01, 0.99)[:, None]
    x = np.concatenate([flight.x[:, :3], flight.x[:, 3:7] * signs, flight.x[:, 7:]], axis=1)
    again = FlightLog(flight.t, x, flight.u)
    np.testing.assert_allclose(again.x, flight.x, atol=1e-12)
    assert again.x[0, 3] >= 0


def test_the_arrays_given_are_not_changed(flight):
    x = -flight.x
    x[:, 3:7] *= 1.01
    before = x.copy()
    FlightLog(flight.t, x, flight.u)
    np.testing.assert_array_equal(x, before)


@pytest.mark.parametrize(
    ("array", "at", "value", "words"),
    [
        ("t", 5, np.nan, ("sample 5", "field t", "nan")),
        ("t", 5, 0.0, ("sample 5", "field t", "goes back")),
        ("t", 6, 0.05, ("sample 6", "repeats")),
        ("x", (7, 8), np.inf, ("sample 7", "field vy", "inf")),
        ("u", (3, 2), np.nan, ("sample 3", "field u2")),
        ("u", (3, 2), -1.0, ("sample 3", "field u2", "negative")),
        ("x", (9, slice(3, 7)), 0.0, ("sample 9", "qw", "norm is 0")),
        ("x", (9, 3), 1e200, ("sample 9", "qw", "is 1e+200")),
        ("x", (9, 0), 2e9, ("sample 9", "px", "is 2e+09")),
    ],
)
def test_impossible_values_are_named(flight, array, at, value, words):
    broken = {"t": flight.t.copy(), "x": flight.x.copy(), "u": flight.u.copy()}
    broken[array][at] = value
    refusal(lambda: FlightLog(**broken, name="mine"), "mine", *words)


def test_shapes_must_agree(flight):
    refusal(lambda: FlightLog(flight.t[1:], flight.x, flight.u), "(n, 13)")
    refusal(lambda: FlightLog(flight.t[:0], flight.x[:0], flight.u[:0]), "no samples")
