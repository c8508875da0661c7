"""The mistakes of the table in docs/howto/logs.md are found on one flight; the benchmark counts them on many."""

import numpy as np
import pytest

from benchmarks.log_mistakes import MISTAKES, NOISE, parts_of, said
from hybrid_jax.flights.log import FlightLog

ALL = {f"{kind}: {name}": made for kind, mistakes in MISTAKES.items() for name, made in mistakes.items()}


@pytest.fixture(scope="module")
def parts(flight):
    rng = np.random.default_rng(0)
    return parts_of(FlightLog(flight.t, flight.x + NOISE * rng.normal(size=flight.x.shape), flight.u))


def test_nothing_is_said_of_a_sound_flight(parts):
    assert said(parts) == []


@pytest.mark.parametrize("mistake", ALL)
def test_every_mistake_is_named(parts, mistake):
    make, words = ALL[mistake]
    lines = [line for _, line in said(make(parts))]
    assert any(words in line for line in lines), lines
