"""Laws of the choice between changes, and of windows that are correlated."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import Push, flown, pendulum, pushes

import hybrid_jax as hj
from hybrid_jax.adaptation import adapt, selection
from hybrid_jax.adaptation.evidence import STRONG, Posterior, better, posterior
from hybrid_jax.adaptation.plausible import extended, free_parameters, rivals
from hybrid_jax.adaptation.selection import Fit, Unchanged, alike, blocks_of, correlated, fit_each
from hybrid_jax.dynamics import Terms
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.normal_equations import NormalEquations, equations_of
from hybrid_jax.trajectories import windows_of


def flight(steps, stride, seed=0):
    inputs = np.random.default_rng(seed).normal(size=(400, 1)).astype(np.float32)
    start = np.array([1.0, 0.0], np.float32)
    states = np.concatenate([start[None], np.asarray(hj.rollout(pendulum(), start, inputs, 0.05))])
    noise = 0.01 * np.random.default_rng(seed).normal(size=states.shape)
    return windows_of((states + noise).astype(np.float32), inputs, 0.05, steps=steps, stride=stride)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("stride", [1, 5, 6, 8])
def test_windows_of_one_flight_are_correlated_whether_they_touch_overlap_or_not(stride):
    windows = flight(5, stride)
    assert correlated(windows) == -(-len(windows) // 5)
    assert len(alike(flown(pendulum()), jax.tree.map(np.float64, windows))) == len(windows)


def test_of_few_windows_that_are_repeated_no_copy_is_left_in_if_another_is_left_out():
    few, many = flown(pendulum(), count=6), flown(pendulum(), count=30)
    starts = np.asarray(alike(few, many).x0)[:, 0]
    left, counted = blocks_of(30, 6)
    for block in left:
        others = np.setdiff1d(np.arange(30), block)
        assert not np.isin(starts[block], starts[others]).any()
    assert counted.all()
    assert set(starts) == {*np.asarray(few.x0)[:, 0]}


def test_windows_that_overlap_are_adapted_to_with_a_warning():
    with pytest.warns(UserWarning, match="windows overlap: left-out blocks share samples"):
        adapt(pendulum(0.7), flight(5, 2)[:40], method="source")


FREE = np.array([[False, False], [True, False], [True, True]])


@eqx.filter_jit
def chosen(start, apparent, size=1.0):
    """Which of `FREE` is taken, and how probable each is, where the source has other gains than the truth."""
    windows, _ = pushes(40, noise=0.3)
    fits = fit_each(Push(start), windows, FREE[[0, 2]], jnp.full(2, 1e6), None, None, 50)[0]  # hardly any prior
    source, every = (jax.tree.map(lambda leaf, i=i: leaf[i], fits) for i in (0, 1))
    return posterior(source, every, start, FREE, jnp.full(2, size), jnp.full(2, apparent))


def test_a_change_is_believed_if_the_evidence_is_strong_and_the_source_does_not_err_as_much():
    truth = jnp.array([3.0, -2.0])
    for away, taken in (([0.0, 0.0], 0), ([0.5, 0.0], 1), ([0.5, 0.5], 2)):
        found = chosen(truth + jnp.array(away), jnp.zeros(()))
        assert found.taken == taken
        np.testing.assert_allclose(found.probability.sum(), 1, rtol=1e-5)
        assert taken == 0 or found.probability[taken] > STRONG * found.probability[0]
        np.testing.assert_allclose(found.theta[taken], truth, atol=0.25 if taken else 1e-6)
    erring = chosen(truth + jnp.array([0.5, 0.0]), jnp.array(0.25))
    assert erring.taken == 0
    assert erring.naive[1] > STRONG * erring.naive[0]  # it would be believed of an exact source


@pytest.mark.parametrize(("square", "moved"), [(1.0, 2.9), (3.0, 0.0), (np.nan, 0.0), (1.0, 3.1)])
def test_a_wind_replaces_the_force_that_it_was_mistaken_for_if_its_own_fit_is_better_and_plausible(square, moved):
    larger = extended(hj.rigid_body(hj.IRIS, terms=Terms(drag=(0.5, 0.4, 0.2))), 13)
    candidates, start = [*free_parameters(larger)], ravel_parameters(larger)[0]
    force, wind, p = candidates.index("force"), candidates.index("wind"), len(start)
    assert rivals(candidates)[[force, wind, 0]].tolist() == [wind, force, 0]
    equations = NormalEquations(jnp.zeros((10, p, p)), jnp.zeros((10, p)), jnp.full(10, 2.0))
    fit = Fit(start, equations, jnp.ones(()), jnp.ones(p, bool), 1, 0)
    other = fit._replace(theta=start + moved, equations=equations._replace(square=jnp.full(10, square)))
    equal = jnp.full(len(candidates), 1 / len(candidates))
    chosen = Posterior(start, equal, equal, jnp.array(force), jnp.ones(p))
    given = chosen, jnp.array(wind), Unchanged(jnp.zeros(p), jnp.zeros(())), jnp.ones(p)
    (found,), now = better(larger, fit, ((fit,), (other,)), *given)
    assert (now.taken, found.equations.square[0]) == ((wind, 1.0) if moved == 2.9 else (force, 2.0))
    np.testing.assert_allclose(now.probability.sum(), 1, rtol=1e-5)
    odds = now.probability[wind] / now.probability[force]
    np.testing.assert_allclose(odds, np.nan_to_num(np.exp(5 * (2 - square))) * (moved < 3), rtol=1e-4)


def test_left_out_blocks_confirm_a_change_of_all_and_not_of_two():
    @jax.jit
    def confirmed(errors):
        def fit(offset):
            r = errors - offset
            equations = NormalEquations(jnp.ones((10, 1, 1)), -r[:, None], r**2)
            return Fit(jnp.array([offset]), equations, 0.01, jnp.array([True]), 1, 0)

        found, blocks = fit(errors.mean()), blocks_of(10, 10)
        thetas = selection.left_out_thetas(found, jnp.array([True]), 1.0, 0.0, blocks)
        return selection.surely_lower(found, fit(0.0), thetas, blocks)

    assert [confirmed(each) for each in (np.linspace(0.5, 1.5, 10), np.repeat([3.0, 0.0], [2, 8]))] == [True, False]


@pytest.mark.parametrize(("least", "sure"), [(0.1, True), (-0.5, False)])
def test_large_gains_of_some_blocks_do_not_hide_the_small_ones_of_others(least, sure):
    gains, blocks = np.repeat([4.0, 1.0, least], [2, 3, 5]), blocks_of(10, 10)
    still = NormalEquations(jnp.ones((10, 1, 1)), jnp.zeros((10, 1)), jnp.ones(10))
    before, after = (
        Fit(jnp.zeros(1), still._replace(square=jnp.exp(-own)), 0.01, jnp.array([True]), 1, 0)
        for own in (0 * gains, gains)
    )
    assert selection.surely_lower(after, before, jnp.zeros((10, 1)), blocks) == sure


def test_single_precision_suffices_where_a_prior_is_far_wider_than_what_the_windows_determine():
    rng, p = np.random.default_rng(0), 20
    jacobian = rng.normal(size=(100, 30, p)) * np.logspace(-2, 2, p)
    jacobian[..., 1] += jacobian[..., -1] / 100  # the windows hardly distinguish these two
    errors = rng.normal(size=(100, 30)) - 50 * jacobian[..., 0]
    free = np.arange(p) == np.array([[-1], [0]])
    free = np.concatenate([free, ~free[1:], ~free[:1]])  # nothing, the first, all others, all

    def choice(dtype):
        j, r = jacobian.astype(dtype), errors.astype(dtype)
        equations = jax.vmap(equations_of)(*map(jnp.asarray, (j, r)))
        every = np.linalg.lstsq(j.reshape(-1, p), -r.ravel())[0]
        source = Fit(jnp.zeros(p), equations, jnp.ones(()), jnp.ones(p, bool), 1, 0)
        every = source._replace(theta=jnp.asarray(every), equations=source.at(every))
        found = jax.jit(posterior)(source, every, jnp.zeros(p), free, jnp.full(p, 100.0), jnp.zeros(p))
        return int(found.taken), float(found.probability[1])

    with jax.enable_x64(True):
        exact = choice(np.float64)
    assert choice(np.float32) == exact == (1, 1)
