"""Laws of the error to expect on a flight that was not seen, and of combining several sources' estimates."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from pendulum import LENGTH, flown, hybrid, pendulum, swings
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.adaptation import expectation
from hybrid_jax.adaptation.expectation import errors_at_ends, expected, expected_errors, lines_of, longest_chain
from hybrid_jax.adaptation.pooling import combined, satterthwaite
from hybrid_jax.adaptation.results import Parameter
from hybrid_jax.adaptation.selection import blocks_of
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.rotation import from_axis_angle
from hybrid_jax.state_space import StateSpace
from hybrid_jax.trajectories import concatenate, split, windows_of

LINE = StateSpace().padded(1)


@pytest.mark.parametrize("skewed", [False, True])
def test_the_interval_holds_another_flight_s_error_in_four_of_five_cases(skewed):
    """Blocks of one flight share a level, as those of one manoeuvre do; after a second most of a mean is in a few."""
    rng, shape = np.random.default_rng(0), (2000, 2, 10, 1, 1)
    blocks = np.exp(1.3 * rng.normal(size=shape)) if skewed else rng.gamma(2.0, size=shape)
    flights = blocks * np.exp((0.5 if skewed else 0.25) * rng.normal(size=(2000, 2, 1, 1, 1)))
    held = []
    for seen, other in flights:
        ((_, low, high),) = expected_errors(np.broadcast_to(seen, (10, 2, 1)), (0.1, 0.1), LINE)["0.1 s"].values()
        held.append(low <= np.sqrt(other.mean()) <= high)
    assert 0.7 <= np.mean(held) <= 0.9


def test_the_value_is_the_rmse_over_all_blocks_and_points_of_a_grid():
    squares = np.random.default_rng(0).gamma(2.0, size=(7, 2, 3))
    found = expected_errors(squares, (0.1, 1.0), StateSpace().padded(3))
    assert [*found] == ["0.1 s", "1 s"]
    for horizon, errors in enumerate(found.values()):
        for i, (value, low, high) in enumerate(errors.values()):
            assert value == pytest.approx(np.sqrt(squares[:, horizon, i].mean()))
            assert low < value < high
    value, low, high = expected_errors(np.ones((1, 2, 4)), (1.0, 1.0), hj.Grid((4,)).state_space)["1 s"]["component 0"]
    assert (value, low, high) == (1.0, 0.0, np.inf)  # one block bounds nothing


def test_a_small_rotation_is_given_in_radians():
    turned = from_axis_angle(jnp.array([0.0, 0.6, 0.8]), jnp.asarray(0.02)) - jnp.array([1.0, 0, 0, 0])
    squares = np.zeros((2, 2, 13))
    squares[..., 3:7] = np.square(turned)
    found = expected_errors(squares, (0.1, 0.1), RIGID_BODY_SPACE)
    assert found["0.1 s"]["attitude"][0] == pytest.approx(0.02, rel=1e-3)
    assert "attitude 0.02 (0.02 to 0.02) rad" in lines_of(found, dict.fromkeys(found["0.1 s"], "rad"))[0]


def test_errors_after_windows_that_touch_are_those_of_one_long_prediction():
    whole = swings(1, steps=24)
    head, rest = split(whole, 8)
    chained = concatenate([head, *split(rest, 8)])
    field = pendulum(0.8)
    found = errors_at_ends(field, chained, jnp.ones(3, bool))
    alone = hj.rollout_batch(field, chained.x0, chained.u, whole.dt)[:, -1] - chained.x[:, -1]
    long = hj.rollout_batch(field, whole.x0, whole.u, whole.dt)[:, -1] - whole.x[:, -1]
    np.testing.assert_allclose(found[0], np.square(alone).mean(axis=0), rtol=1e-4)
    np.testing.assert_allclose(found[1], np.square(long).mean(axis=0), rtol=1e-4)
    assert longest_chain(chained, blocks_of(3, 1)) == 3
    assert longest_chain(chained, blocks_of(3, 3)) == 1  # blocks of one window
    padded = errors_at_ends(field, chained[np.array([0, 1, 2, 2])], jnp.array([True, True, True, False]))
    np.testing.assert_allclose(padded, found, rtol=1e-5)


@pytest.mark.parametrize("flights", [2, 3, 6, 12])
def test_the_interval_of_several_flights_holds_another_one_that_differs_from_them(flights):
    """Of the twelve all but one are the source's; one in twenty is unlike these and bounds nothing."""
    rng, shape = np.random.default_rng(0), (2000, flights + 1, 10)
    squares = np.exp(rng.normal(size=(2000, flights + 1, 1)) + 0.1 * rng.normal(size=shape)).mean(axis=-1)
    held = []
    for *seen, other in squares:
        own, given = np.broadcast_to(np.reshape(seen, (-1, 1, 1)), (flights, 2, 1)), ((0.1, 0.1), LINE)
        new = {"of_source": own[1:]} if flights == 12 else {"flights": True}
        ((_, low, high),) = expected_errors(own[: None if "flights" in new else 1], *given, **new)["0.1 s"].values()
        held.append(low <= np.sqrt(other) <= high)
    assert np.mean(held) == pytest.approx(0.8, abs=0.04)


def test_errors_to_expect_are_those_of_each_flight_with_what_the_others_teach():
    """Flights are of different length; each has a torque of its own, which the field lacks."""
    given = [flown(pendulum(), n, seed=seed) for seed, n in enumerate((40, 40, 30))]
    given = [replace(each, u=each.u + push) for each, push in zip(given, (0.0, 0.3, -0.2), strict=True)]
    found = hj.adapt(pendulum(0.7), given)
    assert "RMSE to expect on a new recording (80% intervals" in found.report()
    errors = []
    for i, one in enumerate(given):
        field = hj.adapt(pendulum(0.7), concatenate(given[:i] + given[i + 1 :])).field
        errors.append(hj.rollout_batch(field, one.x0, one.u, one.dt)[:, -1] - one.x[:, -1])
    logs = np.log([float(jnp.sqrt(jnp.mean(each[:, 0] ** 2))) for each in errors])
    np.testing.assert_allclose(found.expected["0.4 s"]["x[0]"], expected(logs), rtol=0.01)


def test_the_source_is_asked_on_parts_of_its_flights_that_are_as_long_as_the_new_one():
    whole, field = swings(12, steps=40), pendulum(0.8)
    states = np.concatenate([whole.x0[:, None], whole.x], axis=1)
    known = concatenate([windows_of(x, u, whole.dt, steps=4) for x, u in zip(states, np.asarray(whole.u), strict=True)])
    assert expectation.parts_of_flights(known, known[:10]) == [slice(i, i + 10) for i in range(0, 120, 10)]
    assert expectation.parts_of_flights(known, known[:11]) == expectation.parts_of_flights(known[::2], known[:10]) == []
    found = hj.adapt(field, known[:10], learned_from=known)
    away = np.asarray(hj.rollout_batch(field, known.x0, known.u, whole.dt)[:, -1] - known.x[:, -1])
    logs = np.log(np.mean(np.square(away).reshape(12, 10, 2), axis=1)) / 2
    for (value, _, high), own in zip(found.expected["0.2 s"].values(), logs.T, strict=True):
        assert np.log(high / value) == pytest.approx(1.3634 * 2**0.5 * own.std(ddof=1), rel=1e-3)  # Student, 11, 90 %


def test_a_flight_unlike_those_learned_from_is_named():
    slow = flown(hybrid(LENGTH))
    fast = replace(slow, x0=4 * slow.x0, x=4 * slow.x)
    same = hj.adapt(hybrid(), slow, method="source", learned_from=slow)
    assert max(same.outside.values()) < 0.03
    assert "Warning" not in same.report()
    other = hj.adapt(hybrid(), fast, method="source", learned_from=slow)
    assert other.outside["x[1]"] > 0.3
    assert other.outside["u[0]"] < 0.03
    assert "Warning: x[1] is outside the source's training range" in other.report()


def test_the_interval_holds_errors_within_and_between_sources():
    """The truth is one more draw from where the sources' estimates lie, and all share the noise of the windows."""
    rng = np.random.default_rng(0)
    noise, draws = 0.1 * rng.normal(size=2000), 0.3 * rng.normal(size=(2000, 5))
    found = [combined(own[1:] + shared, np.full(4, 0.1**2)) for shared, own in zip(noise, draws, strict=True)]
    held = [abs(centre - own[0]) <= away for (centre, away), own in zip(found, draws, strict=True)]
    assert np.mean(held) == pytest.approx(0.95, abs=0.02)


def test_sources_that_differ_widen_the_interval():
    exact = swings(40, damping=0.0)
    noise = 0.02 * np.random.default_rng(0).normal(size=exact.x.shape).astype(np.float32)
    windows = replace(exact, x=np.asarray(exact.x) + noise)
    sources = [hj.Hybrid(pendulum(0.7), Bias(np.float32(bias))) for bias in (-0.05, 0.0, 0.06)]
    results = [hj.adapt(source, windows, method="theta_least_squares") for source in sources]
    pooled, alone = hj.pool(results)["log_length"], results[1].parameters["log_length"]
    assert pooled.low < np.log(LENGTH) < pooled.high
    assert pooled.high - pooled.low > 1.5 * (alone.high - alone.low)
    shared = hj.pool([replace(each, covariance=1e4 * each.covariance) for each in results])["log_length"]
    assert shared.high - shared.low > 50 * (alone.high - alone.low)  # all may have absorbed the same
    assert pooled.value == pytest.approx(np.mean([each.parameters["log_length"].value for each in results]), abs=1e-5)
    effective = [{"log_length": replace(each.parameters["log_length"], effective="why")} for each in results]
    most = [replace(each, parameters=own) for each, own in zip(results[:2], effective, strict=False)]
    assert hj.pool([*most, results[2]])["log_length"] == Parameter(pooled.value, effective="why")
    assert hj.pool([most[0], *results[1:]])["log_length"] == pooled


class Bias(hj.AbstractVectorField):
    rate: np.ndarray

    def __call__(self, x, u):
        return self.rate * np.array([0.0, 1.0], np.float32) * x


def test_two_sources_or_one_without_intervals_are_refused():
    results = [hj.adapt(pendulum(), swings(40), method="theta_least_squares")] * 3
    refusal(lambda: hj.pool(results[:2]), "results must come from at least 3 source models, got 2")
    refusal(lambda: hj.pool(results[0]), "results must be a list of Adaptation, got Adaptation")
    tuned = hj.adapt(pendulum(), swings(40), method=hj.FineTune(max_epochs=1))
    with pytest.raises(ValueError, match=r"results\[2\] has no intervals: they are valid for least squares only"):
        hj.pool([*results[:2], tuned])


@pytest.mark.parametrize("of_target", [0.1, 0.3, 0.5, 0.9])
def test_intervals_hold_if_a_part_of_the_variance_is_known_better_than_the_rest(of_target):
    """Of the variance a share is the target's, known from five blocks, and the rest the source's, from a hundred."""
    rng, shares, freedom = np.random.default_rng(0), np.array([of_target, 1 - of_target]), np.array([4.0, 99.0])
    error = rng.normal(size=5000)
    found = shares[:, None] * rng.chisquare(freedom[:, None], (2, 5000)) / freedom[:, None]
    degrees = satterthwaite(found, freedom)
    within = np.abs(error) / np.sqrt(found.sum(axis=0)) <= scipy.stats.t.ppf(0.975, degrees)
    assert np.mean(within) == pytest.approx(0.95, abs=0.012)  # four standard deviations of the mean
    assert freedom[0] <= degrees.min()
    assert degrees.max() <= freedom.sum()


def test_few_degrees_of_freedom_widen_the_interval_and_a_parameter_that_is_not_determined_has_some():
    """Of equal estimates it is Student's, but for the correction of Barnard and Rubin."""
    found = satterthwaite(np.array([[np.inf, 0.0, 1.0], [1.0, 0.0, 0.0]]), np.array([4.0, np.inf]))
    np.testing.assert_allclose(found, [4.0, 4.0, 4.0])
    wide, narrow = (combined(np.full(3, 2.0), np.full(3, 0.25), degrees=degrees)[1] for degrees in (9, np.inf))
    assert 2.26 / 1.96 * narrow < wide < 1.4 * narrow
    # Hardly any variance within: it is Student's interval of the estimates alone, also with few blocks of windows.
    _, away = combined(np.array([1.0, 2.0, 3.0]), np.full(3, 1e-9), degrees=9)
    assert away == pytest.approx(scipy.stats.t.ppf(0.975, 2) * np.sqrt(4 / 3), rel=1e-6)
