"""What samples in hover do not tell stays as it was; a wrong sensor is no change, and its sign is named."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from hybrid_jax.state_space import Quantity, StateSpace

DT, NOISE, SECOND, HOVER = 0.01, 0.02, 100, 9.8


class Climb(hj.AbstractVectorField):
    """v̇ = gain u − g: at a constant u only a sum of gain and a disturbance explains what is measured."""

    gain: jax.Array

    def __call__(self, x, u):
        return self.gain * u - HOVER


@cache
def filter_of(noise):
    """It believes that more moves the vehicle than does, as every filter should."""
    return hj.OnlineAdaptation(Climb(jnp.array(1.0)), DT, noise, 0.2, disturbance=3.0, indices=(0,), process=0.005)


@eqx.filter_jit
def hovering(adaptation, noise, key, steps, change=0.0, sensor=1.0, turned=1.0, swing=0.0, gusts=0.0, alarms=0.0):
    """States of a filter, after some alarms, while a controller holds a speed in gusts of an rms [m/s²] that last for a
    second; and the errors of the acceleration that its model and the first one expect. Halfway the gain changes, the
    sensor by a factor, or the sign of what the input that the filter is given adds to hover."""

    def step(carry, given):
        v, y, gust, state = carry
        i, (white, other) = given
        late = i >= steps // 2
        u = HOVER - 4 * (y - swing * jnp.sin(5 * DT * i))
        gust = (1 - DT) * gust + gusts * jnp.sqrt(2 * DT) * other
        true = (1 + jnp.where(late, change, 0.0)) * u - HOVER + gust
        errors = jnp.stack([adaptation.model(state)(y[None], u[None])[0], u - HOVER]) - true
        v = v + DT * true
        y = jnp.where(late, sensor, 1.0) * v + noise * white
        told = HOVER + jnp.where(late, turned, 1.0) * (u - HOVER)
        state = adaptation.update(state, y[None], told[None])
        return (v, y, gust, state), (state, errors)

    zero = jnp.zeros(())
    begun = eqx.tree_at(lambda state: state.alarms, adaptation.begin(zero[None]), jnp.asarray(alarms))
    given = jnp.arange(steps), jax.random.normal(key, (steps, 2))
    return jax.lax.scan(step, (zero, zero, zero, begun), given)[1]


def gains(adaptation, states):
    """θ of the gain and its standard deviation, in units of the prior."""
    at = adaptation.names.index("gain")
    return np.asarray(states.trusted[:, at]), np.sqrt(np.asarray(states.covariance[:, 1 + at, 1 + at]))


@pytest.mark.parametrize("noise", [NOISE, NOISE / 10], ids=["noisy", "quiet"])
def test_what_hover_does_not_tell_stays_with_its_variance_and_gusts_are_not_taken_for_another_gain(noise):
    """A filter that learns all is off by three standard deviations of the prior after this minute."""
    adaptation = filter_of(noise)
    states, _ = hovering(adaptation, noise, jax.random.key(0), 60 * SECOND)
    theta, deviation = gains(adaptation, states)
    assert np.abs(theta).max() < 0.1
    assert deviation.min() > 0.8
    assert adaptation.flags(states).unexcited[SECOND:, adaptation.names.index("gain")].all()
    assert np.linalg.eigvalsh(np.asarray(states.covariance[::SECOND], float)).min() > 0
    adaptation = filter_of(noise)
    states, errors = hovering(adaptation, noise, jax.random.key(0), 60 * SECOND, gusts=1.0)
    theta, deviation = gains(adaptation, states)
    adapted, first = np.sqrt(np.mean(np.square(errors[2 * SECOND :]), axis=0))
    assert adapted < first
    assert np.abs(theta).max() < 0.5
    assert (np.abs(theta) < 2 * deviation).mean() > 0.95
    assert adaptation.flags(states).inconsistent.mean() < 0.1


def test_after_repeated_alarms_more_excitation_is_needed():
    """They are of gusts that the random walk of the disturbance does not follow yet."""
    adaptation = filter_of(NOISE)
    given = adaptation, NOISE, jax.random.key(0), 2 * SECOND
    calm, gusty = (hovering(*given, swing=2.0, alarms=alarms)[0] for alarms in (1.0, 4.0))
    assert gains(adaptation, calm)[1][-1] < 0.1
    assert gains(adaptation, gusty)[1][-1] > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("gusts", [0.0, 1.0])
def test_a_million_steps_leave_the_covariance_positive_and_the_gain_where_it_was(gusts):
    """Nearly three hours, in single precision."""
    adaptation = filter_of(NOISE)
    states, _ = hovering(adaptation, NOISE, jax.random.key(1), 10**6, gusts=gusts)
    sizes = np.linalg.svd(np.asarray(states.root[::100], float), compute_uv=False)
    assert sizes.min() > 0
    theta, deviation = gains(adaptation, states)
    assert (np.abs(theta) < 2 * deviation).mean() > 0.95
    assert np.abs(theta).max() < 1
    assert states.restarts[-1] == 0


def test_a_change_is_found_within_a_second_as_far_as_samples_tell_it():
    after = 13 * SECOND
    hover, _ = hovering(filter_of(NOISE), NOISE, jax.random.key(0), 24 * SECOND, change=0.2)
    assert hover.changes[after] == 1
    force = HOVER / 1.2  # the input that holds the speed now
    scales = np.array(filter_of(NOISE).scales) * [force, 1.0]
    assert hover.trusted[after] @ scales == pytest.approx(0.2 * force, rel=0.05)  # by gain or disturbance
    swung, _ = hovering(filter_of(NOISE), NOISE, jax.random.key(0), 24 * SECOND, change=0.2, swing=1.0)
    assert gains(filter_of(NOISE), swung)[0][after] == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize(("sensor", "turned", "swing"), [(-1.0, 1.0, 1.0), (57.3, 1.0, 0.3), (1.0, -1.0, 1.0)])
def test_a_wrong_sensor_or_input_ends_the_adaptation_at_the_last_model_that_was_consistent(sensor, turned, swing):
    """Another sign, another unit, and exchanged rotors."""
    adaptation, wrong = filter_of(NOISE), {"sensor": sensor, "turned": turned, "swing": swing}
    states, _ = hovering(adaptation, NOISE, jax.random.key(0), 24 * SECOND, **wrong)
    assert adaptation.flags(states).inconsistent[15 * SECOND :].all()
    assert np.abs(states.trusted[15 * SECOND :]).max() < 0.1


def test_a_wrong_sensor_in_gusts_leaves_a_model_without_them():
    def flight(key):
        return hovering(filter_of(NOISE), NOISE, key, 24 * SECOND, sensor=-1.0, swing=1.0, gusts=1.0)[0]

    states = jax.vmap(flight)(jax.random.split(jax.random.key(5), 8))
    assert filter_of(NOISE).flags(states).inconsistent[:, 15 * SECOND :].all()
    assert np.abs(states.trusted[:, 15 * SECOND :]).max() < 0.5


SENSORS = 0.001, 0.02


class Spring(hj.AbstractVectorField):
    stiffness: jax.Array

    @property
    def state_space(self):
        return StateSpace((Quantity("position", 1, "m"), Quantity("speed", 1, "m/s")), disturbed=slice(1, 2))

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - self.stiffness * x[0]])


@jax.jit
def oscillating(key, sign, noise, stiffness, swing):
    """Flags in ten seconds of two swings a second, in a force that jumps; every other position is missing."""
    adaptation = hj.OnlineAdaptation(Spring(jnp.array(10.0)), DT, SENSORS, 3.0, disturbance=3.0)

    def step(carry, given):
        x, state = carry
        i, white = given
        u = 12 * swing * jnp.cos(4 * jnp.pi * DT * i)[None]
        push = jnp.where(i % 200 < 100, 0.0, 2.0 * swing)
        x = hj.integrate.rk4_step(Spring(stiffness), x, u + push, DT)
        seen = jnp.array([1.0, sign]) * x + noise * jnp.array(SENSORS) * white
        state = adaptation.update(state, seen.at[0].set(jnp.where(i % 2, seen[0], jnp.nan)), u)
        return (x, state), adaptation.flags(state)

    begun = jnp.zeros(2), adaptation.begin(jnp.zeros(2))
    return jax.lax.scan(step, begun, (jnp.arange(1000), jax.random.normal(key, (1000, 2))))[1]


@pytest.mark.parametrize(
    ("sign", "noise", "stiffness", "swing"),
    [(1.0, 1.0, 10.0, 1.0), (1.0, 1.7, 10.0, 0.0), (1.0, 1.0, 3.0, 1.0), (-1.0, 1.0, 10.0, 1.0)],
    ids=["force", "rest with more noise", "another stiffness", "wrong sign"],
)
def test_a_wrong_sign_is_named_and_nothing_else_is_taken_for_one(sign, noise, stiffness, swing):
    keys = jax.random.split(jax.random.key(0), 8)
    flags = jax.vmap(lambda key: oscillating(key, sign, noise, stiffness, swing))(keys)
    assert not flags.reversed[..., 0].any()
    if sign < 0:
        assert flags.reversed[:, 200:, 1].all()
        assert flags.inconsistent[:, 200:].all()
    else:
        assert not flags.reversed.any()
