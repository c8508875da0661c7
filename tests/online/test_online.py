"""Laws of adaptation while a system runs."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from hybrid_jax.dynamics.disturbance import ConstantDisturbance, disturbance_of, with_disturbance
from hybrid_jax.integrate import rk4_step
from hybrid_jax.online import OnlineAdaptation, Tuning

DT, NOISE = 0.05, 0.01
CALM = Tuning(caution=0.0, alarm=1e3, gusts=1.0, drift=0.0, clip=1e3, excitation=0.0)  # the plain Kalman filter


class Slide(hj.AbstractVectorField):
    """ẋ = u − c x, and a parameter that samples do not show."""

    friction: jax.Array
    idle: jax.Array

    def __call__(self, x, u):
        return u - self.friction * x + 0 * self.idle


class Pushed(hj.AbstractVectorField):
    """ẋ = u + p, linear in state and parameter together."""

    push: jax.Array

    def __call__(self, x, u):
        return u + self.push


SLIDE, HELD = Slide(jnp.array(1.0), jnp.array(1.0)), {"friction": 1.0, "idle": 0.0}


def run(field, steps, seed=0, change=None, noise=NOISE):
    """Samples and inputs of a slide, whose friction is another from a step on."""
    rng = np.random.default_rng(seed)
    u = 2 * rng.normal(size=(steps, 1)).astype(np.float32)
    fields = [change[1] if change and i >= change[0] else field for i in range(steps)]
    x, samples, step = jnp.zeros(1), [], eqx.filter_jit(rk4_step)
    for one, held in zip(fields, u, strict=True):
        x = step(one, x, jnp.asarray(held), DT)
        samples.append(np.asarray(x) + noise * rng.normal(size=1))
    return np.array(samples, np.float32), u


@eqx.filter_jit
def watch(adaptation, samples, inputs, elapsed=None):
    elapsed = jnp.ones(len(samples)) if elapsed is None else elapsed
    start = adaptation.begin(jnp.zeros(samples.shape[1]))

    def step(state, given):
        state = adaptation.update(state, *given)
        return state, state

    return jax.lax.scan(step, start, (samples, inputs, elapsed))[1]


def last(states, index=-1):
    return jax.tree.map(lambda leaf: leaf[index], states)


def kalman(samples, inputs, prior):
    """The textbook filter of z = [x, p] for ẋ = u + p, in double precision."""
    z, covariance = np.zeros(2), np.diag([NOISE**2, prior**2])
    ahead, row = np.array([[1, DT], [0, 1]]), np.array([1.0, 0.0])
    for (y,), (u,) in zip(samples.astype(float), inputs.astype(float), strict=True):
        z, covariance = ahead @ z + [DT * u, 0], ahead @ covariance @ ahead.T
        gain = covariance @ row / (covariance[0, 0] + NOISE**2)
        z, covariance = z + gain * (y - z[0]), covariance - np.outer(gain, covariance[0])
    return z, covariance


def test_on_a_linear_system_it_is_the_kalman_filter():
    samples, inputs = run(Pushed(jnp.array(0.4)), 60)
    adaptation = OnlineAdaptation(Pushed(jnp.array(0.0)), DT, NOISE, prior=0.5, tuning=CALM)
    found, (z, covariance) = last(watch(adaptation, samples, inputs)), kalman(samples, inputs, 0.5)
    scales = np.array([1.0, 0.5])
    np.testing.assert_allclose(np.concatenate([found.x, 0.5 * found.theta]), z, atol=2e-5)
    np.testing.assert_allclose(scales[:, None] * found.covariance * scales, covariance, rtol=1e-2, atol=1e-8)


@cache
def adaptation():
    return OnlineAdaptation(SLIDE, DT, NOISE, prior=0.5)


def test_intervals_hold_what_is_found_after_a_change():
    """Of twenty runs at least 16 must contain the true value, which 95 % intervals miss once in 400 times."""
    changed = Slide(jnp.array(1.8), jnp.array(1.0))
    runs = [run(SLIDE, 160, seed, (60, changed)) for seed in range(20)]
    states = jax.vmap(lambda s, u: watch(adaptation(), s, u))(*(jnp.stack(part) for part in zip(*runs, strict=True)))
    inside = 0
    for i in range(20):
        found = adaptation().intervals(last(states, (i, -1)))["friction"]
        assert found.high - found.low < 0.4
        inside += bool(found.low <= 1.8 <= found.high)
    assert inside >= 16
    assert (states.changes[:, 59] == 0).mean() >= 0.8
    assert (states.changes[:, 100] > 0).mean() >= 0.9


def test_without_a_change_the_estimate_stays_within_its_interval_and_what_nothing_excites_where_it_was():
    states = watch(adaptation(), *run(SLIDE, 200, seed=5))
    assert adaptation().names == ("friction", "idle")
    assert states.changes[-1] == 0
    away = jnp.abs(states.theta[50:, 0]) / jnp.sqrt(states.covariance[50:, 1, 1])
    assert away.max() < 3.5
    assert adaptation().flags(last(states)).unexcited.tolist() == [False, True]
    assert not states.theta[:, 1].any()


SPOILED = {
    "missing": lambda x, u: (x.at[50:90].set(jnp.nan), u),
    "infinite": lambda x, u: (x.at[50:90].set(jnp.inf), u),
    "unknown input": lambda x, u: (x, u.at[50:90].set(jnp.nan)),
    "frozen": lambda x, u: (x.at[50:90].set(x[50]), u),
}


@pytest.mark.parametrize("name", SPOILED)
def test_bad_samples_keep_the_last_good_estimate(name):
    samples, inputs = SPOILED[name](*map(jnp.asarray, run(SLIDE, 90)))
    states = watch(adaptation(), samples, inputs)
    flags = adaptation().flags(last(states))
    np.testing.assert_allclose(states.trusted[-1], states.trusted[51], atol=0.2)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(states))
    assert states.restarts[-1] == 0
    if name != "unknown input":
        assert flags.missing.all() & flags.gap
        assert flags.frozen.all() == (name == "frozen")


def test_what_the_model_cannot_explain_is_not_believed_and_after_a_gap_it_goes_on_from_the_sample():
    samples, inputs = run(SLIDE, 120)
    samples[60:] += 3 * np.random.default_rng(1).normal(size=(60, 1))  # the sensor has broken
    states = watch(adaptation(), samples, inputs)
    assert adaptation().flags(last(states)).inconsistent
    np.testing.assert_allclose(states.trusted[-1], states.settled[59], atol=0.05)
    samples, inputs = map(jnp.asarray, run(SLIDE, 120))
    jumped = jnp.concatenate([samples[:60], samples[80:]]), jnp.concatenate([inputs[:60], inputs[80:]])
    elapsed = jnp.ones(100).at[60].set(21.0)
    states = watch(adaptation(), *jumped, elapsed)
    assert adaptation().flags(last(states, 60)).gap
    np.testing.assert_allclose(states.x[60], samples[80], atol=1e-6)
    np.testing.assert_allclose(states.trusted[60], states.trusted[59], atol=1e-6)
    assert states.changes[-1] == 0


def test_a_field_that_has_a_disturbance_is_adapted_with_it_or_keeps_it():
    pushed = hj.Hybrid(SLIDE, ConstantDisturbance(jnp.array([0.5]), (0,)))
    samples, u = run(pushed, 100)
    held = watch(OnlineAdaptation(pushed, DT, NOISE), samples, u)
    assert OnlineAdaptation(pushed, DT, NOISE).names[-1] == "disturbance[0]"
    assert not held.theta[:, -1].any()
    learning = OnlineAdaptation(with_disturbance(SLIDE, (0,)), DT, NOISE, disturbance=1.0, tuning=CALM)
    found = learning.model(last(watch(learning, samples, u)))
    assert disturbance_of(found).value == pytest.approx([0.5], abs=0.05)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"prior": {"frition": 0.1}}, "prior: frition must be among friction, idle"),
        ({"prior": {"friction": 0.1}}, "prior: idle must be given, 0 if it should stay constant"),
        ({"prior": 0.0}, "prior must be positive for at least one parameter, got 0 for all"),
        ({"disturbance": 1.0}, "indices must say"), ({"noise": 0.0}, "noise must be"),
        ({"disturbance": (1.0, 1.0), "indices": (0,)}, "disturbance must be one number, or 1, one for each dist"),
        ({"hypotheses": hj.Hypothesis("a", {"idle": 0.3})}, "hypotheses must be a list of Hypothesis, got Hypothesis"),
        ({"hypotheses": [hj.Hypothesis("a", {"idle": 1})], "prior": HELD}, "hypothesis a: idle must be among"),
        ({"field": hj.Model(SLIDE)}, "field: must be a function .* got Model; pass its .field"),
    ],
)  # fmt: skip
def test_a_filter_that_makes_no_sense_is_refused(options, said):
    with pytest.raises(ValueError, match=f"^{said}"):
        OnlineAdaptation(**({"field": SLIDE, "dt": DT, "noise": NOISE} | options))


def test_a_sample_is_a_list_or_an_array_of_the_size_of_the_first():
    state = adaptation().begin([0.0])
    assert eqx.tree_equal(adaptation().update(state, [0.1], [1]), adaptation().update(state, np.array([0.1]), [1.0]))
    with pytest.raises(ValueError, match=r"^noise must be one number, or 1, one for each state, got 2"):
        OnlineAdaptation(SLIDE, DT, (NOISE, NOISE)).begin([0.0])
    with pytest.raises(ValueError, match=r"^x must be one sample of shape \(1,\), like the state, got shape \(2,\)"):
        adaptation().update(state, [0.0, 0.0], [0.0])
    with pytest.raises(ValueError, match=r"^elapsed must be a finite number of at least 0, got -1"):
        adaptation().update(state, [0.0], [0.0], elapsed=-1)


@pytest.mark.parametrize("hypotheses", [(), (hj.Hypothesis("drag", {"friction": 1.0}),)], ids=["alone", "hypotheses"])
def test_a_parameter_with_a_prior_of_zero_is_held(hypotheses):
    held = OnlineAdaptation(SLIDE, DT, NOISE, HELD, hypotheses=hypotheses)
    state = last(watch(held, *run(Slide(jnp.array(1.7), SLIDE.idle), 150)))
    found, intervals = held.model(state), held.intervals(state)
    assert found.idle == intervals["idle"].low == intervals["idle"].high == SLIDE.idle
    assert intervals["friction"].low < 1.7 < intervals["friction"].high
    assert state.restarts == 0


def test_times_follow_the_period_of_a_slow_system():
    """As in hours: the filter of a system whose samples are 600 times as far apart is the same."""
    slow = Slide(SLIDE.friction / 600, SLIDE.idle)
    found = OnlineAdaptation(slow, 600 * DT, NOISE, prior={"friction": 0.5 / 600, "idle": 0.5})
    samples, inputs = run(SLIDE, 60)
    quick, late = watch(adaptation(), samples, inputs), watch(found, samples, inputs / 600)
    np.testing.assert_allclose(late.theta, quick.theta, atol=1e-3)
    assert not found.flags(late).gap.any()
