"""The choice by flights left out, on made-up scores; predictions with what was seen before, of recorded flights."""

from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from recorded import LOGS

import hybrid_jax as hj
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.dynamics.vehicle_file import LEARN, VehicleModel
from hybrid_jax.identification import adaptation, learning

FORCE = ConstantDisturbance(jnp.array([0, 0, -1.0, 0, 0, 0]))  # of which the flights know nothing
LACKING = hj.Hybrid(hj.rigid_body(hj.IRIS), FORCE)
errors = partial(learning.errors_of, steps=learning.STEPS)


@pytest.mark.parametrize(
    ("given", "learned", "told"),
    [
        ((LEARN, 23, True), LEARN, ""), ((("Ix", "drag"), 1, False), ("Ix", "drag"), ""),
        ((LEARN, 23, False), LEARN[:5], "Not learned, as not all logs have a velocity: drag, aerodynamic_moment."),
        ((LEARN, 21, True), ("Ix", "Iy", "k"), "Not learned, as 21 s of flight are too few, 22 s are needed: Iz, k"),
    ],
)  # fmt: skip
def test_what_is_learned_by_default_follows_from_the_logs(given, learned, told):
    learn, seconds, moves = given
    model, left = learning.learnable(VehicleModel(hj.IRIS, learn=learn), seconds, 0.1, moves)
    assert (model.learn, left.startswith(told), bool(left)) == (learned, True, bool(told))


@pytest.fixture(scope="module")
def model():
    return learning.with_past(LACKING, LOGS[:6])


def test_a_push_that_the_model_lacks_is_predicted_from_the_errors_before_but_not_by_weights_of_zero(model):
    assert eqx.tree_equal(learning.without_past(model), LACKING)
    before, after = (errors(field, LOGS[7])[2:, -1, 1].mean() for field in (LACKING, model))
    assert after < 0.3 * before
    still = eqx.tree_at(lambda each: each.weights, model, 0 * model.weights)
    np.testing.assert_allclose(errors(still, LOGS[7]), errors(LACKING, LOGS[7]), atol=2e-5)


def test_errors_to_expect_of_a_past_are_of_flights_that_it_was_not_learned_from(model):
    flown = LOGS[6:]
    found = adaptation.expected_with_past(model, flown, ["0.1 s", "2 s"])
    pasts = [learning.with_past(model, flown[:i] + flown[i + 1 :]) for i in range(3)]
    ends = [learning.rmse(errors(past, log))[-1] for past, log in zip(pasts, flown, strict=True)]
    assert [*found] == ["0.1 s"]  # the flights are shorter than 2 s
    np.testing.assert_allclose(np.transpose([*found["0.1 s"].values()]), learning.expected(np.log(ends)), rtol=1e-4)
    one = adaptation.expected_with_past(model, flown[:1], ["0.1 s"])["0.1 s"]["velocity"]
    assert one[1:] == (0.0, np.inf)  # one stretch bounds nothing; half of it is shorter than what a past remembers


@pytest.mark.parametrize(
    ("short", "long", "stretches", "worse"),
    [
        (1.3, 1.3, 6, True), (1.0, 1.0, 6, False), (0.7, 0.7, 6, False),
        (1.3, 0.5, 6, False),  # better in the long run
        (1.3, None, 6, True),  # flights too short for the long run
        (1.3, 1.3, 4, False),  # too few to be sure
    ],
)  # fmt: skip
def test_a_change_is_undone_if_its_predictions_with_the_past_are_surely_worse(short, long, stretches, worse):
    random = np.random.default_rng(0)

    def errors(*shares):
        sizes = {k: share for k, share in zip(adaptation.HORIZONS, shares, strict=True) if share}
        return [[{k: x * random.uniform(0.95, 1.05, 4) for k, x in sizes.items()}] for _ in range(stretches)]

    assert adaptation._surely_larger(errors(short, long), errors(1.0, long and 1.0)) == worse


GOOD = [-0.5, -0.4, -0.6, -0.5]


def scores(**flights):
    """Scores of the baseline, and of further candidates by flight."""
    return {name: np.array(each, float) for name, each in ({"thrust": [0.0] * 4} | flights).items()}


@pytest.mark.parametrize(
    ("learned", "chosen"),
    [
        ({"a": GOOD}, "a"),
        ({"a": [0.1, -0.1, 0.2, 0.1]}, "thrust"),  # nothing beats the baseline
        ({"a": [-0.9, -0.9, -0.9, 0.5]}, "thrust"),  # the best on average, terrible on one flight
        ({"a": [-0.9, -0.9, -0.9, 0.5], "b": [-0.1, -0.2, -0.1, -0.1]}, "b"),
        ({"a": GOOD, "b": [-0.52, -0.38, -0.61, -0.49]}, "a"),  # as good as the simpler one
        ({"a": GOOD, "b": [-0.6, -0.5, -0.7, -0.6]}, "b"),  # better on every flight
        ({"a": [np.nan, -2, -2, -2], "b": GOOD}, "b"),
        ({"a": [np.inf] * 4}, "thrust"),
    ],
)
def test_choice(learned, chosen):
    assert learning.choose(scores(**learned)) == chosen
    moved = {name: each + np.array([0.3, -0.2, 0.1, 0.5]) for name, each in scores(**learned).items()}
    assert learning.choose(moved) == chosen  # how hard a flight is does not matter


def test_a_baseline_is_mostly_taken_where_others_are_better_by_chance():
    rng = np.random.default_rng(0)
    taken = [learning.choose(scores(**{f"m{i}": rng.normal(0.1, 0.3, 4) for i in range(5)})) for _ in range(200)]
    assert np.mean([name == "thrust" for name in taken]) > 0.6


@pytest.mark.parametrize(("flights", "parts"), [(1, 5), (2, 3), (3, 2), (7, 1)])
def test_interval_holds_another_flight_in_eight_of_ten_cases(flights, parts):
    """Several flights differ twice as much as parts of one, another one from a single flight as much as these."""
    rng, n, spread = np.random.default_rng(1), flights + 1, 0.6 if flights > 1 else 0.3
    logs = rng.normal(-3, spread, (2000, n, 1, 1)) + rng.normal(0, 0.3, (2000, n, parts, 1))
    found = np.squeeze([learning.expected_from_parts(np.exp(each[:-1])) for each in logs])
    truth = [learning.rmse(np.exp(each[-1]))[0] for each in logs]
    assert np.mean((found[:, 1] < truth) & (truth < found[:, 2])) == pytest.approx(0.8, abs=0.05)
