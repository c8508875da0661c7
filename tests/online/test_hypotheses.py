"""Laws of the hypotheses of a change: which one is found, what stays as it was, and what lies outside them."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal
from test_online import last, watch

import hybrid_jax as hj
from hybrid_jax.integrate import rk4_step

DT, NOISE, STEPS, CHANGE = 0.05, 0.01, 220, 80


class Cart(hj.AbstractVectorField):
    """ẍ = −stiffness x − friction ẋ + gain u + push."""

    stiffness: jax.Array
    friction: jax.Array
    gain: jax.Array
    push: jax.Array

    def __call__(self, x, u):
        force = -self.stiffness * x[0] - self.friction * x[1] + self.gain * u[0] + self.push
        return jnp.stack([x[1], force])


TRUTH = {"stiffness": 1.0, "friction": 0.5, "gain": 1.0, "push": 0.0}
HYPOTHESES = (
    hj.Hypothesis("spring", {"stiffness": 0.5}),
    hj.Hypothesis("damper", {"friction": 0.5}),
    hj.Hypothesis("load", together=({"stiffness": -0.3, "friction": -0.15, "gain": -0.3},)),
    hj.Hypothesis("wind", {"push": 1.0}, rates={"push": 0.5}, lead=0.2),
)


def cart(**changes):
    return Cart(**{name: jnp.asarray(value, float) for name, value in (TRUTH | changes).items()})


@cache
def adaptation(hypotheses=True):
    return hj.OnlineAdaptation(cart(), DT, NOISE, prior=0.5, process=0.01, hypotheses=HYPOTHESES if hypotheses else ())


@jax.jit
def flown(after, key, rate=0.0):
    """Samples and inputs of a cart whose parameters change at a step, and whose push then grows at a rate."""
    u_key, noise_key = jax.random.split(key)
    u = 2 * jax.random.normal(u_key, (STEPS, 1))

    def step(x, given):
        i, held = given
        field = jax.tree.map(lambda a, b: jnp.where(i < CHANGE, a, b), cart(), after)
        grown = field.push + rate * DT * jnp.maximum(i - CHANGE, 0)
        x = rk4_step(Cart(field.stiffness, field.friction, field.gain, grown), x, held, DT)
        return x, x

    x = jax.lax.scan(step, jnp.zeros(2), (jnp.arange(STEPS), u))[1]
    return x + NOISE * jax.random.normal(noise_key, x.shape), u


def watched(hypotheses, after, seeds=6, rate=0.0):
    """The last state of the filter of each run, and the θ of its model after each sample."""
    keys = jax.random.split(jax.random.key(3), seeds)
    runs = [watch(adaptation(hypotheses), *flown(after, key, rate)) for key in keys]
    states = jax.tree.map(lambda *leaves: np.stack(leaves), *runs)
    return jax.tree.map(lambda leaf: leaf[:, -1], states), states.trusted * np.array(adaptation(hypotheses).scales)


def errors(theta, after):
    true = np.stack([getattr(after, name) - TRUTH[name] for name in adaptation().names])
    return np.mean(np.linalg.norm(theta[:, -40:] - true, axis=-1))


def test_until_a_change_the_model_stays_exactly_as_it_was():
    found, theta = watched(True, cart())
    assert not found.changes.any()
    np.testing.assert_array_equal(theta, 0)


CAUSES = {"spring": {"stiffness": 1.6}, "damper": {"friction": 1.2}}
CAUSES |= {"load": {"stiffness": 0.7, "friction": 0.35, "gain": 0.7}}


@pytest.mark.parametrize("name", CAUSES)
def test_a_cause_is_found_and_told_better_than_by_all_parameters(name):
    after = CAUSES[name]
    found, theta = watched(True, cart(**after))
    assert (found.changes > 0).all()
    place = 2 + [hypothesis.name for hypothesis in HYPOTHESES].index(name)
    kind = found.mixture.previous + np.where(found.mixture.log_weights[:, 1:-1] == 0, 1.0, 0.0)
    assert (kind[:, place - 1] > 0).mean() >= 0.8
    assert errors(theta, cart(**after)) < 0.8 * errors(watched(False, cart(**after))[1], cart(**after))


def test_alarms_that_follow_each_other_do_not_make_it_forget_a_cause():
    """What was known before them is a hypothesis, too."""
    samples, inputs = flown(cart(stiffness=1.6), jax.random.key(3))
    states = watch(adaptation(), samples, inputs)
    found = state = last(states, -4)
    alarmed = jnp.full((2, 4), 1e3), jnp.asarray(9.0)
    for x, u in zip(samples[-3:], inputs[-3:], strict=True):
        state = eqx.tree_at(lambda state: (state.mixture.test.pull, state.mixture.test.quiet), state, alarmed)
        state = eqx.filter_jit(adaptation().update)(state, x, u)
    assert state.changes == found.changes + 3
    np.testing.assert_allclose(state.trusted, found.trusted, atol=0.2)
    assert np.abs(found.trusted - found.settled).max() > 0.5
    assert not adaptation().flags(state).inconsistent


def test_what_is_outside_all_causes_is_found_no_worse_and_a_push_that_grows_is_delivered_ahead():
    """Two things at once, which only the filter of all parameters explains."""
    both = cart(stiffness=1.8, gain=0.5, push=0.6)
    found, alone = (errors(watched(hypotheses, both, seeds=24)[1], both) for hypotheses in (True, False))
    assert found < 1.2 * alone
    ahead, rate = HYPOTHESES[-1].lead, 0.15
    _, theta = watched(True, cart(push=0.5), rate=rate)
    push = adaptation().names.index("push")
    wanted = 0.5 + rate * (DT * (STEPS - 1 - CHANGE) + ahead)
    np.testing.assert_allclose(theta[:, -1, push].mean(), wanted, atol=0.12)


def test_intervals_hold_the_truth_with_and_without_a_number_of_their_own():
    after = cart(stiffness=1.6)
    found, _ = watched(True, after, seeds=12)
    inside = []
    for i in range(12):
        made = adaptation().intervals(last(found, i))
        inside += [made[name].low <= getattr(after, name) <= made[name].high for name in TRUTH]
        assert all(made[name].high > made[name].low for name in TRUTH)
    assert np.mean(inside) >= 0.85


def test_bad_samples_keep_the_model_and_its_weights_and_hypotheses_that_cannot_be_are_refused():
    samples, inputs = flown(cart(stiffness=1.6), jax.random.key(3))
    states = watch(adaptation(), samples.at[-6:].set(jnp.nan), inputs)
    assert np.ptp(states.trusted[-7:], axis=0).max() < 1e-3
    assert np.ptp(states.mixture.log_weights[-7:], axis=0).max() < 1e-6
    assert adaptation().flags(states).gap[-1]
    assert states.restarts[-1] == 0
    refusal(lambda: hj.Hypothesis("a"), "hypothesis a: parameters must contain")
    refusal(lambda: hj.Hypothesis("a", {"push": 1.0}, rates={"gain": 1.0}), "hypothesis a: rates must be of its")
