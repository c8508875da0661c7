"""Tables of a report on recorded flights: missing values are stated and do not affect the others."""

import math

import pytest

from experiments.real_flight.rows import QUANTITIES, TAGS
from experiments.real_flight.tables import choice_tables, parameter_tables
from experiments.reporting.results import Results

NOMINAL = {"Ix": 1.0, "drag": 0.0}


def row(fold, theta):
    scores = {"10": dict.fromkeys(QUANTITIES, 1.0)}
    interval = {name: [value - 1, value + 1] for name, value in theta.items() if value is not None}
    tags = dict(zip(TAGS, (fold, "hybrid", "source_only", 0, 0), strict=True))
    return tags | {"scores": scores, "theta": theta, "theta_interval": interval}


@pytest.mark.parametrize(
    ("second", "text"),
    [
        ({"Ix": 3.0, "drag": 5.0}, "4 ± 1 [3, 5]"),
        ({"Ix": 3.0}, "3 [2, 4] (1 of 2 folds)"),  # its recipe learns no drag
        ({"Ix": 3.0, "drag": None}, "nan ± nan [2, 4]"),  # its drag is not finite
    ],
)
def test_parameter_is_the_mean_over_folds_that_learn_it(second, text):
    (table,) = parameter_tables(Results([row("a", {"Ix": 2.0, "drag": 3.0}), row("b", second)], TAGS), NOMINAL)
    assert [line[-1] for line in table.lines] == ["2.5 ± 0.7 [1.5, 3.5]", text]


@pytest.mark.parametrize("errors", [(math.nan, 0.7, 0.6), (0.7, math.inf, 0.6), (0.7, math.nan, 0.6), (0.6, 0.6, 0.5)])
def test_chosen_recipe_has_the_smallest_finite_error(errors):
    (table,) = choice_tables({"fold": dict(zip("abc", errors, strict=True))})
    assert table.lines[0][-1] == "c"
