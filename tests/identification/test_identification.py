"""Identification from commands and measurements recovers a simulated vehicle, and says what a log does not tell."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from choices import slow
from surface import refusal

import hybrid_jax as hj
from hybrid_jax import IRIS, Actuator, actuated
from hybrid_jax.flights.recording import Recording, Signal
from hybrid_jax.identification import identify, identify_in_turn, slow_commands
from hybrid_jax.identification.multirotor import measure
from hybrid_jax.identification.recordings import Layout, initial_states, resampled
from hybrid_jax.records import integral
from hybrid_jax.vehicle import STATE_SIZE

DT, SECONDS = 0.005, 16.0
ACTUATOR = Actuator((100.0, 900.0), time_constants=0.05)
TRUTH = replace(IRIS, inertia=(0.035, 0.026, IRIS.inertia[2]), thrust_coefficient=1.1 * IRIS.thrust_coefficient)
NOISE = {"rates": 0.01, "specific_force": 0.05, "attitude": 0.005, "velocity": 0.02, "position": 0.01}
LAYOUT = Layout(DT, 20, 60, span=0.05)


@cache
def pilot_of(late):
    """A program from shakes to the commands that a pilot gives, which act `late` steps later, and measurements."""
    field = actuated(hj.rigid_body(TRUTH, ()), replace(ACTUATOR, time_constants=0.07))
    hover = (TRUTH.hover_speed - 100) / 900
    roll, pitch = np.sign(np.array(TRUTH.rotor_positions)[:, 1]), -np.sign(np.array(TRUTH.rotor_positions)[:, 0])

    def pilot(x, shake):
        tilt = 2 * x[4:6]
        push = -0.06 * tilt - 0.02 * x[10:12]
        turn = shake[3] * np.array(TRUTH.spin)
        return hover + shake[0] + (push[0] + shake[1]) * roll + (push[1] + shake[2]) * pitch + turn

    def tick(carry, shake):
        x, queue = carry
        queue = jnp.concatenate([pilot(x, shake)[None], queue])
        x = hj.rollout(field, x, queue[late][None], DT)[0]
        measured = {name: measure(name, field, x, queue[late]) for name in NOISE}
        return (x.at[3:7].set(x[3:7] / jnp.linalg.norm(x[3:7])), queue[:-1]), (queue[0], measured)

    x0 = jnp.concatenate([jnp.zeros(STATE_SIZE).at[3].set(1.0), jnp.full(4, TRUTH.hover_speed)])
    start = x0, jnp.full((late + 1, 4), hover)
    return jax.jit(lambda shakes: jax.lax.scan(tick, start, shakes)[1])


def recorded(delay=0.0, noise=1.0, hold=20, smooth=0.0, turning=(0.0, 0.0)):
    """A hover shaken in thrust, roll and pitch, with a pilot that keeps it level, and all that can be measured.

    The shakes are held for `hold` steps and filtered by 1 / (1 − smooth z⁻¹). Yaw is shaken between two times [s].
    """
    rng, n = np.random.default_rng(0), round(SECONDS / DT)
    shakes = np.repeat(rng.normal(size=(n // hold + 1, 3)) * [0.06, 0.01, 0.01], hold, axis=0)[:n]
    shakes = scipy.signal.lfilter([np.sqrt(1 - smooth**2)], [1.0, -smooth], shakes, axis=0)
    t, signals = DT * np.arange(1, n + 1), {}
    yaw = np.where((t > turning[0]) & (t < turning[1]), 0.08 * np.sign(np.sin(8 * t)), 0.0)
    told, measured = pilot_of(round(delay / DT))(jnp.asarray(np.column_stack([shakes, yaw])))
    for name, size in NOISE.items():
        y = np.array(measured[name])
        y += noise * size * rng.normal(size=y.shape)
        axes = ("w", "x", "y", "z") if name == "attitude" else ("x", "y", "z")
        y = y / np.linalg.norm(y, axis=1, keepdims=True) if name == "attitude" else y
        signals[name] = Signal(t, y, axes, name)
    signals["command"] = Signal(t - DT, np.asarray(told), tuple("0123"), "command")
    return Recording("twin", signals)


def only(recording, *names):
    return replace(recording, signals={name: recording.signals[name] for name in ("command", *names)})


@pytest.fixture(scope="module")
def twin():
    return recorded()


def start(body=("Ix", "Iy", "k"), own=("time_constant",)):
    return actuated(hj.rigid_body(IRIS, body), ACTUATOR, own)


TOLD = {"Ix": 0.035, "Iy": 0.026, "k": TRUTH.thrust_coefficient, "time_constant": 0.07}


def holds(found, name):
    return found[name].low <= TOLD[name] <= found[name].high


def near(found, share):
    for name, value in TOLD.items():
        np.testing.assert_allclose(float(found.intervals[name].value), value, rtol=share, err_msg=name)


@pytest.mark.parametrize("fit", [identify, *slow(identify_in_turn)], ids=["at once", "first thrust, then torque"])
def test_gyro_and_accelerometer_alone_tell_inertia_thrust_and_lag(fit, twin):
    found = fit(start(), [only(twin, "rates", "specific_force")], LAYOUT)
    near(found, 0.02)
    # Linear interpolation of the log bends the time constant by a hundredth.
    assert fit is identify_in_turn or all(holds(found.intervals, name) for name in ("Ix", "Iy", "k"))
    assert found.converged
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(found.field))  # as JAX has it, though fitted in 64
    assert found.errors["rates"].max() < 1.5 * NOISE["rates"]


def test_the_delay_of_a_log_is_told_from_the_lag_of_its_rotors():
    found = identify(start(own=("time_constant", "delay")), [only(recorded(delay=0.02), "rates")], LAYOUT)
    np.testing.assert_allclose(float(found.intervals["delay"].value), 0.02, atol=0.001)
    np.testing.assert_allclose(float(found.intervals["time_constant"].value), 0.07, rtol=0.02)


@pytest.mark.slow
def test_what_a_log_does_not_tell_has_an_interval_as_wide_as_that(twin):
    found = identify(start(("Ix", "Iz", "torque_coefficient", "k"), ()), [only(twin, "specific_force")], LAYOUT)
    for name in ("Ix", "Iz", "torque_coefficient"):
        assert float(found.intervals[name].high) > 5 * float(found.intervals[name].value), name
    assert np.isfinite(float(found.intervals["k"].high))


@pytest.mark.slow
def test_windows_are_taken_where_they_tell_something():
    """Yaw is shaken for a tenth of the log only: of 36 windows spread over all of it, its torque has no interval."""
    body = hj.rigid_body(replace(TRUTH, torque_coefficient=0.5 * TRUTH.torque_coefficient), ("torque_coefficient",))
    field = actuated(body, replace(ACTUATOR, time_constants=0.07))
    found = identify(field, [only(recorded(turning=(6.0, 7.5)), "rates")], replace(LAYOUT, most=36))
    value, low, high = map(float, found.intervals["torque_coefficient"])
    assert found.windows == 36
    assert low < TRUTH.torque_coefficient < high < 4 * low
    assert value == pytest.approx(TRUTH.torque_coefficient, rel=0.15)


def test_an_initial_state_has_the_errors_that_it_says(twin):
    clean = recorded(noise=0.0)
    starts = np.arange(1.0, 15.0, 0.05)
    x, spread = initial_states(twin, starts, LAYOUT)
    truth, _ = initial_states(clean, starts, LAYOUT)
    error = (x - truth)[:, [0, 1, 2, 7, 8, 9]]
    ratio = error.std(axis=0) / spread[0, [0, 1, 2, 6, 7, 8]]
    np.testing.assert_allclose(ratio, 1, atol=0.2)


def test_a_fast_signal_is_averaged_without_delay_and_a_slow_one_is_there_at_its_own_times_only():
    fine = np.arange(0, 2, 0.001)
    grid = 0.01 * np.arange(10, 110)[None]
    values, there = resampled(Signal(fine, np.sin(5 * fine)[:, None], ("x",), "fast"), grid, 0.01)
    np.testing.assert_allclose(values[0, :, 0], np.sin(5 * grid[0]), atol=2e-3)
    assert there.all()
    _, there = resampled(Signal(fine[::100], np.sin(5 * fine[::100])[:, None], ("x",), "slow"), grid, 0.01)
    assert 9 <= there.sum() <= 11


def test_the_accelerometer_feels_thrust_and_no_gravity():
    field, x = hj.rigid_body(IRIS, ()), jnp.zeros(13).at[3].set(1.0)
    force = measure("specific_force", field, x, jnp.full(4, IRIS.hover_speed))
    np.testing.assert_allclose(force, [0, 0, 9.81], atol=1e-4)
    np.testing.assert_allclose(measure("specific_force", field, x, jnp.zeros(4)), 0, atol=1e-5)


def test_what_is_missing_or_too_short_is_named(twin):
    charged = actuated(hj.rigid_body(IRIS, ("Ix",)), replace(ACTUATOR, nominal_voltage=15.0, voltage_exponent=1.0))
    rates = [only(twin, "rates")]
    refusal(lambda: identify(start(), rates, LAYOUT, ("velocity",)), "has no velocity")
    refusal(lambda: identify(start(), rates, replace(LAYOUT, steps=10_000)), "in flight without a gap")
    refusal(lambda: identify(charged, rates, LAYOUT), "has no battery voltage")
    refusal(lambda: identify(start(), rates, replace(LAYOUT, most=3)), "windows for")


# What commands did between the samples of a slow log is unknown, and counts as that.
STEP = 0.1
MIX = np.array([[1.0, 0.0], [0.8, 0.3]])


def test_a_random_walk_is_a_line_and_a_bridge_between_its_samples_and_noise_is_told_from_it():
    """It has a covariance of M Mᵀ in a second, and samples a tenth of a second apart."""
    steps = np.random.default_rng(0).normal(size=(20_000, 2)) @ MIX.T * np.sqrt(0.01)
    t, values = 0.01 * np.arange(20_000), np.cumsum(steps, axis=0)
    sampled = Signal(t[::10], values[::10], ("0", "1"), "walk")
    root = slow_commands.root([sampled])
    np.testing.assert_allclose(root @ root.T, MIX @ MIX.T, rtol=0.05, atol=0.02)
    line = integral(sampled, 0.01 * np.arange(len(values) - 10), "linear")
    middle = slice(4, None, 10)  # the mean from 0.04 to 0.05 s after a sample
    true = (values[4:-1:10] + values[5::10]) / 2
    line = np.diff(line, axis=0)[middle] / 0.01
    strayed = true[: len(line)] - line
    edges = STEP + 0.04 + 0.01 * np.arange(2)
    each = slow_commands.bridges(np.array([[[STEP, 2 * STEP]]]), edges, root)[0, :, 0]
    found = each.T @ each
    assert (np.diag(found) < np.diag(strayed.T @ strayed) / len(strayed)).all()
    np.testing.assert_allclose(found, strayed.T @ strayed / len(strayed), rtol=0.25)
    fast = Signal(0.01 * np.arange(50), np.random.default_rng(0).normal(size=(50, 4)), tuple("0123"), "fast")
    assert slow_commands.count(fast, 0.5) == 0  # fast commands are held, and know no bridge
    assert not slow_commands.root([fast]).any()
    rng, n, t = np.random.default_rng(1), 300, 20
    slopes = rng.normal(size=(n, t, 2, 3)) * np.array([[0.5], [2.0]])
    noise = np.array([0.1, 0.4])
    errors = np.einsum("ntku,nu->ntk", slopes, rng.normal(size=(n, 3))) + noise * rng.normal(size=(n, t, 2))
    r, b = errors.reshape(n, -1), slopes.reshape(n, -1, 3)
    found, whitening = slow_commands.whitened(r, b, np.ones((n, 2 * t), bool), np.tile([0, 1], t))
    np.testing.assert_allclose(found, noise, rtol=0.03)
    white = whitening @ (errors / noise).reshape(n, -1, 1)
    np.testing.assert_allclose((white**2).mean(), 1, rtol=0.05)


@pytest.mark.slow
def test_ten_commands_in_a_second_tell_the_inertia_and_the_intervals_hold():
    """Held between its samples, such a log gives inertias that are too large by a factor of two."""
    twin = only(recorded(hold=4, smooth=0.95), "rates", "specific_force")
    every = twin.signals["command"]
    slow = Signal(every.t[3::20], every.values[3::20], every.axes, "command")
    found = identify(start(), [Recording("slow", {**twin.signals, "command": slow})], LAYOUT)
    assert all(holds(found.intervals, name) for name in TOLD)
    near(found, 0.1)
