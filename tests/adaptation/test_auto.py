"""Laws of the choice by left-out windows, of the candidates and of the anchored network."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import LENGTH, pendulum, swings
from pushes import Push, pushes

import hybrid_jax as hj
from hybrid_jax.adaptation import Auto, FineTune, adapt
from hybrid_jax.adaptation.anchored import fit_anchored, with_change
from hybrid_jax.adaptation.auto import CANDIDATES, extended, free_parameters
from hybrid_jax.adaptation.selection import blocks_of, correlated, fit_candidates, predict_block, simplest
from hybrid_jax.dynamics.disturbance import disturbed
from hybrid_jax.estimation.least_squares import fit_free, fit_least_squares, ravel_parameters
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.trajectories import windows_of


@cache
def hybrid(length=0.7):
    network = hj.residual_network(2, 1, jax.random.key(0), hidden=4, norm="none")
    return hj.Hybrid(pendulum(length), jax.tree.map(lambda leaf: 0.1 * leaf, network))


def flown(truth, count=40, noise=0.003, seed=0):
    """Windows of a field with the states and inputs of a pendulum, and white noise."""
    start = swings(count, seed=seed)
    x = np.asarray(eqx.filter_jit(hj.rollout_batch)(truth, start.x0, start.u, start.dt))
    return replace(start, x=x + noise * np.random.default_rng(seed).normal(size=x.shape).astype(np.float32))


@pytest.mark.parametrize("windows", [1, 9, 10, 25, 100])
def test_blocks_hold_every_window_once_and_in_order(windows):
    places, counted = blocks_of(windows, 10)
    np.testing.assert_array_equal(places[counted], np.arange(windows))
    assert len(places) <= 10


def test_a_left_out_block_is_predicted_by_a_fit_to_the_others():
    """Linear in its parameters, so that one Gauss–Newton step is the whole fit."""
    windows, _ = pushes(40, noise=0.3)
    field = Push(jnp.zeros(2))
    found = fit_candidates(field, windows, np.array([[True, True]]), blocks=8)
    places, _ = blocks_of(40, 8)
    for block, error in zip(places, found.errors.mse[0], strict=True):
        others = np.setdiff1d(np.arange(40), block)
        own = fit_least_squares(field, windows[others]).field
        np.testing.assert_allclose(error, rollout_mse(own, windows[block]), rtol=1e-3)


class Half(hj.AbstractVectorField):
    """A pendulum of which no window tells two parameters apart."""

    first: jax.Array
    second: jax.Array

    def __call__(self, x, u):
        return pendulum(self.first + self.second)(x, u)


def test_a_candidate_whose_parameters_no_window_tells_apart_is_fitted_all_the_same():
    result = adapt(Half(jnp.array(0.3), jnp.array(0.4)), flown(pendulum()))
    assert result.chosen == "theta"
    assert result.field.first + result.field.second == pytest.approx(LENGTH, rel=0.01)
    assert "do not determine first, second: other values fit them as well" in result.report()


def flight(steps, stride, seed=0):
    """Windows of one flight of a pendulum that is pushed at random."""
    inputs = np.random.default_rng(seed).normal(size=(400, 1)).astype(np.float32)
    start = np.array([1.0, 0.0], np.float32)
    states = np.concatenate([start[None], np.asarray(hj.rollout(pendulum(), start, inputs, 0.05))])
    noise = 0.01 * np.random.default_rng(seed).normal(size=states.shape)
    return windows_of((states + noise).astype(np.float32), inputs, 0.05, steps=steps, stride=stride)


@pytest.mark.parametrize("stride", [1, 5, 6, 8])
def test_windows_of_one_flight_are_correlated_whether_they_touch_overlap_or_not(stride):
    windows = flight(5, stride)
    assert correlated(windows) == -(-len(windows) // 5)


def test_windows_of_many_flights_are_not():
    assert correlated(swings(100)) == 1


def test_windows_that_overlap_are_adapted_to_with_a_warning():
    with pytest.warns(UserWarning, match="windows overlap: blocks left out share samples"):
        adapt(pendulum(0.7), flight(5, 2)[:40], method="source")


def test_parameters_that_are_not_free_stay():
    windows, _ = pushes(40, noise=0.1)
    found = fit_free(Push(jnp.array([1.0, -2.0])), windows, None, 50, None, jnp.array([True, False])).field.gains
    assert found[1] == -2.0
    assert abs(found[0] - 3.0) < 0.2
    none = fit_candidates(Push(jnp.array([1.0, -2.0])), windows, np.array([[False, False]]))
    np.testing.assert_array_equal(none.theta[0], [1.0, -2.0])


def test_windows_that_touch_are_predicted_as_one():
    whole = swings(2, steps=24)
    parts = [replace(whole, x0=x0, u=whole.u[:, at : at + 8], x=whole.x[:, at : at + 8])
             for x0, at in zip((whole.x0, whole.x[:, 7], whole.x[:, 15]), (0, 8, 16), strict=True)]  # fmt: skip
    chained = jax.tree.map(lambda *leaves: jnp.stack(leaves, 1).reshape(6, *leaves[0].shape[1:]), *parts)
    field, counted = pendulum(0.8), jnp.ones(6, bool)
    np.testing.assert_allclose(predict_block(field, chained, None, counted).mse, rollout_mse(field, whole), rtol=1e-5)
    apart = chained[np.array([0, 2, 4, 1, 3, 5])]  # none touches the next
    np.testing.assert_allclose(predict_block(field, apart, None, counted).mse, rollout_mse(field, apart), rtol=1e-5)


ERRORS = np.exp(np.random.default_rng(0).normal(size=(1, 10)) * 0.3)


@pytest.mark.parametrize(
    ("factors", "sizes", "taken"),
    [
        ([1.0, 1.05, 1.0], [3, 1, 2], 1),  # a tenth does not count
        ([1.0, 1.3, 1.0], [3, 1, 2], 2),
        ([1.0, 0.5, 0.4], [0, 1, 2], 2),
        ([1.0, np.nan, 0.99], [2, 0, 3], 0),  # what is not finite is not taken
        ([1.0, 1.02, 1.01], [1, 1, 1], 0),  # of one size, the best
    ],
)
def test_the_simplest_candidate_near_the_best_is_taken(factors, sizes, taken):
    assert simplest(jnp.asarray(ERRORS * np.array(factors)[:, None]), np.array(sizes)) == taken


def test_what_a_few_blocks_alone_decide_is_noise():
    errors = np.ones((2, 10))
    errors[0, :2] = 8.0  # the smaller candidate is worse in two blocks, by more than a tenth in the mean
    assert simplest(jnp.asarray(errors), np.array([1, 2])) == 1
    errors[0, 2:] = 0.85
    assert simplest(jnp.asarray(errors), np.array([1, 2])) == 0


@pytest.mark.parametrize(
    ("truth", "chosen"),
    [
        (lambda: hybrid(), "source"),
        (lambda: hybrid(LENGTH), "theta"),
        (lambda: hj.Hybrid(disturbed(pendulum(LENGTH), jnp.array([0.0, 1.5])), hybrid().residual), "disturbance"),
    ],
)
def test_windows_choose_what_changed(truth, chosen):
    found = adapt(hybrid(), flown(truth()))
    assert found.chosen == chosen
    assert found.candidates[chosen] <= 1.5 * min(found.candidates.values())
    assert (found.disturbance is not None) == (chosen == "disturbance")
    length = found.parameters["log_length"]
    assert length.has_interval == (chosen != "source")
    assert np.isnan(float(length.low)) == (chosen == "source")  # a number even where there is no interval
    assert f"Chosen by the error on left-out windows: {chosen}" in found.report()
    if chosen == "source":
        assert eqx.tree_equal(found.field.physics, hybrid().physics)


def test_a_changed_network_is_found_where_physics_cannot_explain_it():
    truth = eqx.tree_at(lambda field: field.residual.bias_out, hybrid(), hybrid().residual.bias_out + 1.0)
    physics = Auto(networks=False).solve(hybrid(), flown(truth), swings(5), hj.Settings()).field
    whole = adapt(hybrid(), flown(truth))
    test = flown(truth, seed=3, noise=0.0)
    assert rollout_mse(whole.field, test) < 1.1 * rollout_mse(physics, test)
    assert whole.chosen in ("disturbance", "network")


def test_a_step_of_the_network_is_held_by_its_penalty():
    windows = flown(hybrid(0.65))
    found = fit_anchored(hybrid(), windows, penalties=(1e6, 1.0, 1e-2), blocks=5)
    sizes = np.linalg.norm(found.changes, axis=1)
    assert sizes[0] < 1e-4 * sizes[2]
    assert (np.diff(sizes) > 0).all()
    errors = [float(rollout_mse(with_change(hybrid(), change), windows)) for change in found.changes]
    assert errors[2] < errors[1] < errors[0]
    np.testing.assert_allclose(errors[0], rollout_mse(hybrid(), windows), rtol=1e-3)


def test_candidates_of_a_rigid_body_fit_what_their_names_say():
    field = extended(hj.rigid_body(hj.IRIS), 13)
    names, free = [*named_parameters(field)], free_parameters(field)
    assert [*free] == [name for name in CANDIDATES if name != "disturbance"]
    assert len(names) == ravel_parameters(field)[0].size == 3 + 4 + 3 + 6

    def fitted(name):
        return {each for each, one in zip(names, free[name], strict=True) if one}

    assert fitted("source") == set()
    assert fitted("theta") == {"Ix", "Iy", "k"}
    assert fitted("drag") == {"Ix", "Iy", "k", *(f"added_drag[{i}]" for i in range(3))}
    # Four efficiencies and k would be five numbers for four.
    assert fitted("efficiency") == {"Ix", "Iy", *(f"efficiency[{i}]" for i in range(4))}


def test_too_few_windows_leave_out_the_large_candidates():
    found = adapt(hybrid(), flown(hybrid(LENGTH), count=4))
    assert "disturbance" not in found.candidates
    with pytest.warns(UserWarning, match="windows: 1 do not determine 1 parameters"):
        assert adapt(hybrid(), flown(hybrid(LENGTH), count=1)).chosen == "source"


def test_a_heavy_penalty_holds_fine_tuning_at_the_source():
    windows, source = flown(hybrid(LENGTH)), hybrid()
    free, held = (
        adapt(source, windows, method=FineTune(rates=1e-3, max_epochs=40, l2_sp=weight)).field for weight in (0.0, 1e4)
    )
    moved = [float(jnp.abs(ravel_parameters(each)[0] - ravel_parameters(source)[0]).max()) for each in (free, held)]
    assert moved[1] < 0.2 * moved[0]
