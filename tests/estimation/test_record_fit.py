"""Records of which not every state was measured: what made them is recovered, and what they do not tell is said."""

from functools import cache

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import Damped
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.dynamics.actuators import SampledRotors
from hybrid_jax.dynamics.hidden import Lag, LinearDynamics, Oscillator, RandomWalk, with_hidden
from hybrid_jax.estimation.elimination import undetermined
from hybrid_jax.records import Record, on_grid
from hybrid_jax.trajectories import pair_inputs, windows_of

NOISE = 0.01


def pendulum(length=0.8, damping=0.3):
    return Damped(jnp.log(jnp.array(length)), jnp.array(damping))


def angle(x, u):
    return x[0]


def record(field, start, length=8.0, samples=80, seed=0, drop=(), noise=NOISE, interval=0.1):
    """Inputs at intervals [s], and a noisy angle at irregular times."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, length, interval)
    torque = t, 2 * random.normal(size=len(t))
    times = np.array([0.0, *np.sort(random.uniform(0, length, samples))])
    times = times[~((times > drop[0]) & (times < drop[1]))] if drop else times
    model = hj.StateSpaceModel(field, ("torque",), {"angle": angle}, start, np.zeros(len(start)))
    y = hj.simulate(model, Record.of("r", torque=torque, angle=(times, 0 * times)), dt=0.01)[0]["angle"][:, 0]
    return Record.of(f"run {seed}", torque=torque, angle=(times, y + noise * random.normal(size=len(times))))


def model_of(field, d=2, spread=np.inf, **options):
    spread = np.broadcast_to(spread, d)
    return hj.StateSpaceModel(field, ("torque",), {"angle": angle}, np.zeros(d), spread, **options)


@cache
def records():
    second = record(pendulum(), (-0.4, 1.0), 6.0, 60, seed=2, drop=(2.0, 3.5), interval=0.25)
    return [record(pendulum(), (0.5, 0.0), seed=1), second]


@pytest.fixture(scope="module")
def fitted():
    return hj.fit_records(model_of(pendulum(1.0, 0.1)), records(), dt=0.02)


def test_parameters_and_starts_are_recovered_within_their_errors_also_by_multiple_shooting_from_a_worse_start(fitted):
    truth = {"log_length": np.log(0.8), "damping": 0.3}
    for name, interval in fitted.intervals.items():
        error = float(interval.high - interval.low) / 3.92
        assert abs(float(interval.value) - truth[name]) < 4 * error < 0.1
    assert (np.abs(fitted.starts - [[0.5, 0.0], [-0.4, 1.0]]) < 4 * fitted.starts_error).all()
    assert fitted.errors["angle"] == pytest.approx(NOISE, rel=0.2)
    assert fitted.status.name == "OK"
    shot = hj.fit_records(model_of(pendulum(2.0, 1.0)), records(), dt=0.02, segment=0.5)
    for name, interval in shot.intervals.items():
        assert float(interval.value) == pytest.approx(float(fitted.intervals[name].value), abs=1e-4)


def test_steps_that_are_too_long_or_too_few_are_said(fitted):
    assert fitted.discretisation < 0.1
    with pytest.warns(UserWarning, match=r"records: the fit stopped at the limit of steps; check all units"):
        assert hj.fit_records(model_of(pendulum()), records(), dt=0.02, max_steps=1).status.name == "CAPPED"
    with pytest.warns(UserWarning, match=r"half the solver's step would move a parameter by .* substeps=2"):
        coarse = hj.fit_records(model_of(pendulum()), records(), dt=0.2, solver=diffrax.Heun())
    assert coarse.discretisation > 1


def test_a_lag_that_is_shorter_than_a_step_is_not_taken_for_known():
    """There is none: the search ends at the shortest for which RK4 is stable, where half the step changes nothing."""
    field = with_hidden(pendulum(), Lag(jnp.log(jnp.array([0.1])), (0,)))
    model = model_of(field, 3, (np.inf, np.inf, 1.0))
    with pytest.warns(UserWarning, match="half the solver's step would move a parameter by inf standard errors"):
        fit = hj.fit_records(model, records(), dt=0.04)
    assert np.exp(fit.intervals["parts.0.log_time_constant[0]"].value) < 0.04 / 2
    assert hj.fit_records(model_of(pendulum()), records()[:1], dt=0.04, max_steps=2).discretisation < 1


def test_several_starts_find_the_minimum_that_one_misses():
    options = {"dt": 0.02, "prior": {"log_length": 1.0}}
    far = model_of(pendulum(0.1, 0.1), noise={"angle": NOISE})
    one, several = (hj.fit_records(far, records()[:1], starts=starts, **options) for starts in (1, 5))
    assert one.errors["angle"] > 10 * NOISE
    assert several.errors["angle"] == pytest.approx(NOISE, rel=0.2)


def test_what_follows_is_predicted_from_what_was_seen(fitted):
    whole = record(pendulum(), (0.3, -0.5), 6.0, 60, seed=3)
    past, future = whole.part(0, 4.0), whole.part(3.9, 9.0)
    torque, signal = future.signals["torque"], future.signals["angle"]
    t, seen = signal.t[signal.t > 4.05], signal.values[signal.t > 4.05]
    y = hj.predict(fitted.model, past, Record.of("future", torque=(torque.t, torque.values), angle=(t, seen)), dt=0.02)
    assert np.sqrt(np.mean((y["angle"] - seen) ** 2)) < 2 * NOISE


@pytest.mark.parametrize("size", [3.0, 30.0])  # the first round must not follow a large one
def test_a_burst_of_outliers_is_set_aside(size):
    torque, signal = (records()[0].signals[name] for name in ("torque", "angle"))
    spoiled = signal.values.copy()
    spoiled[20:24] += size
    spoiled[50] = np.nan  # what is no number is left out
    bad = [Record.of("bad", torque=(torque.t, torque.values), angle=(signal.t, spoiled)), records()[1]]
    start = model_of(pendulum(1.0, 0.1))
    plain, robust = (hj.fit_records(start, bad, dt=0.02, robust=each, rounds=3) for each in (np.inf, 3.0))
    errors = [abs(float(fit.intervals["log_length"].value) - np.log(0.8)) for fit in (plain, robust)]
    assert errors[1] < errors[0] / 5
    assert plain.set_aside["angle"] == 0 < 4 <= robust.set_aside["angle"] <= 10


class Twofold(hj.AbstractVectorField):
    """Two factors of which only the product acts, and a number that nothing depends on."""

    a: jax.Array
    b: jax.Array
    damping: jax.Array
    unused: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - self.a * self.b * x[0] - self.damping * x[1]])


def test_what_no_output_tells_is_named_and_has_no_interval():
    model = model_of(Twofold(*map(jnp.array, (3.0, 3.0, 0.3, 1.0))))
    assert undetermined(np.full((3, 3), np.nan), ["a", "b", "c"]) == []  # where numpy.linalg.eigh raises an error
    with pytest.warns(UserWarning, match="no sample determines .*0.71 a - 0.71 b") as warned:
        fit = hj.fit_records(model, records()[:1], dt=0.02)
    assert set(fit.undetermined) == {"a", "b", "unused"}
    assert (len(warned), float(fit.intervals["unused"].value)) == (1, 1.0)
    assert np.isfinite(float(fit.intervals["damping"].high))


class Slider(hj.AbstractVectorField):
    """The drag is a number, or the exponential of one."""

    gain: jax.Array
    drag: jax.Array | None = None
    log_drag: jax.Array | None = None

    def __call__(self, x, u):
        return self.gain * u - (self.drag if self.log_drag is None else jnp.exp(self.log_drag)) * x


def test_a_logarithm_on_its_way_to_minus_infinity_is_named_and_others_count_it():
    """The data want a negative drag, so its logarithm loses its effect; the gain is not better known for that."""
    t = np.arange(0.0, 3.0, 0.05)
    y = np.expm1(0.02 * t) / 0.02 + NOISE * np.random.default_rng(0).normal(size=len(t))
    data, one = [Record.of("r", push=(t, 0 * t + 1), angle=(t, y))], jnp.array(1.2)

    def fit(field):
        return hj.fit_records(hj.StateSpaceModel(field, ("push",), {"angle": angle}, (0.0,), (0.0,)), data, dt=0.05)

    with pytest.warns(UserWarning, match="records: no sample determines log_drag$"):
        found = fit(Slider(one, log_drag=jnp.log(0.3)))
    known = fit(Slider(one, drag=jnp.array(0.3)))
    assert (found.undetermined, float(found.intervals["log_drag"].value) > -100) == (("log_drag",), True)
    wide, right = (float(each.intervals["gain"].high - each.intervals["gain"].low) for each in (found, known))
    assert wide > right


def oscillator():
    return Oscillator(jnp.log(5.0), jnp.array(-2.0), jnp.array([0.0, 0.0, 3.0]), jnp.array([4.0]), (1,))


HIDDEN = [(Lag(jnp.log(jnp.array([0.2])), (0,), order), order, "log_time_constant") for order in (1, 3)]


@pytest.mark.parametrize(("part", "extra", "name"), [*HIDDEN, (oscillator(), 2, "log_frequency")])
def test_a_hidden_part_is_found(part, extra, name):
    true, truth = with_hidden(pendulum(), part), getattr(part, name)
    data = [record(true, (0.5, 0.0, *(0.0,) * extra), seed=4, samples=200, noise=1e-3)]
    start = eqx.tree_at(lambda field: getattr(field.parts[0], name), true, truth + 0.2)
    frozen = eqx.tree_at(lambda field: field.field, start, hj.Frozen(pendulum()))
    model = model_of(frozen, 2 + extra, (np.inf,) * 2 + (1.0,) * extra, noise={"angle": 1e-2})
    fit = hj.fit_records(model, data, dt=0.02)
    assert np.asarray(getattr(fit.model.field.parts[0], name)) == pytest.approx(np.asarray(truth), abs=0.05)


class Decay(hj.AbstractVectorField):
    rate: jax.Array

    def __call__(self, x, u):
        return -self.rate * x


def test_an_interval_from_few_samples_is_not_narrower_than_of_independent_errors():
    """The errors are at samples that tell little of the rate, so a sandwich is much too narrow."""
    t = np.r_[np.linspace(0, 0.1, 9), 0.5, 1.0, 1.5]
    y = np.exp(-t) + 0.05 * (-1.0) ** np.arange(12) * (t <= 0.1)
    model = hj.StateSpaceModel(Decay(jnp.array(1.1)), (), {"angle": angle}, (1.0,), (0.0,))
    fit = hj.fit_records(model, [Record.of("r", angle=(t, y))], dt=0.05)
    found = fit.intervals["rate"]
    rate, width = float(found.value), float(found.high - found.low)
    variance = np.sum((y - np.exp(-rate * t)) ** 2) / 11 / np.sum((t * np.exp(-rate * t)) ** 2)
    assert width == pytest.approx(2 * 1.96 * np.sqrt(variance), rel=0.01)


class Stiff(hj.AbstractVectorField):
    """A slow state, and one that follows within a tenth of a millisecond."""

    log_rate: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1] - jnp.exp(self.log_rate) * x[0], 1e4 * (jnp.cos(x[0]) - x[1])])


@pytest.mark.slow
def test_a_stiff_system_is_fitted_with_an_implicit_solver():
    def model(rate, spread):
        return hj.StateSpaceModel(Stiff(jnp.log(jnp.array(rate))), (), {"y": angle}, (1.0, 0.5), spread)

    t, solver = np.arange(0, 5, 0.1), diffrax.Kvaerno5()
    y = hj.simulate(model(0.7, (0, 0)), Record.of("r", y=(t, 0 * t)), dt=0.1, solver=solver)[0]["y"][:, 0]
    data = Record.of("r", y=(t, y + 1e-3 * np.random.default_rng(0).normal(size=len(t))))
    fit = hj.fit_records(model(1.2, (0.5, 0.5)), [data], dt=0.1, solver=solver)
    assert float(fit.intervals["log_rate"].value) == pytest.approx(np.log(0.7), abs=3e-3)


@pytest.mark.parametrize("lag", [0.004, 0.05])
def test_the_lag_of_rotors_is_found_from_samples_also_if_some_stand_still(lag):
    t, speeds, states = np.linspace(0, 0.01, 1001)[:, None], [np.zeros(2)], [np.zeros(2)]
    for command in [np.zeros(2)] * 3 + [*np.random.default_rng(0).uniform(0, 10, (200, 2))]:
        path = command + (speeds[-1] - command) * np.exp(-t / lag)
        speeds, states = [*speeds, path[-1]], [*states, states[-1] + np.trapezoid(path**2, t, axis=0)]
    windows = pair_inputs(windows_of(np.array(states), np.array(speeds[:-1]), 0.01, steps=10))
    field = with_hidden(lambda x, u: u**2, SampledRotors(jnp.log(0.015), 0.01))
    found = hj.fit_least_squares(field, windows).field.parts[0]
    assert float(jnp.exp(found.log_time_constant)) == pytest.approx(lag, rel=1e-3)


def test_linear_dynamics_are_an_oscillator():
    w, z = 5.0, np.exp(-2.0)
    a = jnp.array([[0.0, 1.0], [-(w**2), -2 * z * w]])
    linear = LinearDynamics(a, jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0]]), jnp.array([[4.0, 0.0]]), (1,))
    x, u = jnp.array([0.3, -0.2, 0.1, 0.4]), jnp.array([0.7])
    one, other = (with_hidden(pendulum(), part)(x, u) for part in (linear, oscillator()))
    np.testing.assert_allclose(one, other, rtol=1e-5)


def test_a_disturbance_that_walks_is_followed():
    """A push that jumps in the middle: the part without process noise cannot follow, that with it does."""
    true, t = pendulum(), np.arange(0.0, 8.0, 0.02)
    made = Record.of("made", torque=(t, np.where(t < 4, 1.0, -1.0)), angle=(t, 0 * t))
    known = hj.StateSpaceModel(true, ("torque",), {"angle": angle}, (0.0, 0.0), (0.0, 0.0))
    y = hj.simulate(known, made, dt=0.02)[0]["angle"][:, 0] + NOISE * np.random.default_rng(0).normal(size=len(t))
    data = [Record.of("data", torque=(t, 0 * t), angle=(t, y))]
    fixed = with_hidden(hj.Frozen(true), RandomWalk((1,)))
    ends = []
    for noise in (0.0, 1.0):
        model = model_of(fixed, 3, (0.1, 0.1, 2.0), process=(0, 0, noise), noise={"angle": NOISE})
        ends.append(hj.fit_records(model, data, dt=0.02, segment=0.2, rounds=1).ends[0, 2])
    assert abs(ends[1] + 1) < 0.3 < abs(ends[0] + 1)


@pytest.mark.parametrize("between", ["held", "averaged", "linear"])
def test_the_mean_of_an_input_over_intervals_keeps_its_integral(between):
    t, u = np.array([[0.0, 0.3, 0.5, 1.1, 2.0], [1.0, -2.0, 0.5, 3.0, 1.0]])
    parts = {"held": u[:-1], "averaged": u[1:], "linear": (u[1:] + u[:-1]) / 2}[between] * np.diff(t)
    found = on_grid(Record.of("r", u=(t, u), y=(t, u)), ("u",), ("y",), 0.1, between)
    assert found.u.sum() * 0.1 == pytest.approx(parts.sum())
    assert found.u[0, 0] == pytest.approx({"held": 1.0, "averaged": -2.0, "linear": 0.5}[between])


def test_what_is_wrong_is_said_in_a_line():
    for wrong, *said in (
        ({"records": [Record.of("r", torque=([0, 1], [0, 1]))]}, "r: has no angle; it has torque"),
        ({"prior": {"mass": 1.0}}, "prior: the model has no mass; it has log_length, damping"),
        ({"between": "cubic"}, "between must be one of held, linear, averaged, got 'cubic'"),
        ({"dt": 0.0}, "dt must be a positive number of seconds"),
        ({"segment": 9.0}, "segment must be at most the ", " s of the longest record, got 9"),
        ({"records": [Record.of("r", torque=([0, 1], [0, 1]), angle=([5, 6], [0, 1]))]}, "torque, angle overlap"),
    ):
        options = {"records": records(), "dt": 0.02} | wrong
        refusal(lambda options=options: hj.fit_records(model_of(pendulum()), **options), *said)
