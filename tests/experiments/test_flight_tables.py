"""The tables of a report on recorded flights: what is missing is said, and spoils nothing that is there."""

import math

import pytest

from experiments.real_flight.rows import QUANTITIES, FlightRow
from experiments.real_flight.tables import choice_tables, parameter_tables

NOMINAL = {"Ix": 1.0, "drag": 0.0}


def row(fold, theta):
    scores = {"10": dict.fromkeys(QUANTITIES, 1.0)}
    interval = {name: [value - 1, value + 1] for name, value in theta.items() if value is not None}
    return FlightRow(fold, "hybrid", "source_only", 0, 0, "", 1, scores, theta=theta, theta_interval=interval)


@pytest.mark.parametrize(
    ("second", "said"),
    [
        ({"Ix": 3.0, "drag": 5.0}, "4 ± 1 [3, 5]"),
        ({"Ix": 3.0}, "3 [2, 4] (1 of 2 folds)"),  # its recipe learns no drag
        ({"Ix": 3.0, "drag": None}, "nan ± nan [2, 4]"),  # its drag is not finite
    ],
)
def test_a_parameter_is_the_mean_of_the_folds_that_learn_it(second, said):
    (table,) = parameter_tables([row("a", {"Ix": 2.0, "drag": 3.0}), row("b", second)], NOMINAL)
    assert [line[-1] for line in table.lines] == ["2.5 ± 0.7 [1.5, 3.5]", said]


@pytest.mark.parametrize("errors", [(math.nan, 0.7, 0.6), (0.7, math.inf, 0.6), (0.7, math.nan, 0.6), (0.6, 0.6, 0.5)])
def test_what_was_taken_is_the_least_finite_error(errors):
    (table,) = choice_tables({"fold": dict(zip("abc", errors, strict=True))})
    assert table.lines[0][-1] == "c"
