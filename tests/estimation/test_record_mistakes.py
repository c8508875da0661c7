"""Units, times and angles that cannot be right are named, and so is what a past does not tell of the future."""

import dataclasses

import numpy as np
import pytest
from test_record_fit import NOISE, angle, model_of, pendulum, record

from hybrid_jax import StateSpaceModel, fit_records, predict, simulate
from hybrid_jax.estimation.record_search import check_rates
from hybrid_jax.records import Record, Signal


def test_inputs_that_nobody_knows_between_past_and_future_are_not_held():
    near = np.arange(0, 1, 0.1)
    times = {"past": near, "future": near + 9}
    past, future = (Record.of(name, torque=(t, t), angle=(t, t)) for name, t in times.items())
    with pytest.raises(ValueError, match=r"^future: torque begins at 9 s, and the past ends at 0\.9 s$"):
        predict(model_of(pendulum()), past, future, dt=0.02)


@pytest.mark.parametrize("factor", [180 / np.pi, 1e-3])
def test_a_rate_in_another_unit_than_its_angle_is_said(factor):
    outputs = {"angle": angle, "rate": lambda x, u: x[1]}
    model = StateSpaceModel(pendulum(), ("torque",), outputs, (1.0, 0.0), (0.1, 0.1))
    t = np.delete(np.arange(0.0, 4.0, 0.05), np.s_[20:55])
    y = simulate(model, Record.of("r", torque=(t, 0 * t), angle=(t, t), rate=(t, t)), dt=0.05)[0]
    noisy = y["angle"] + 0.02 * np.random.default_rng(0).normal(size=y["angle"].shape)
    right, wrong = (Record.of("r", torque=(t, 0 * t), angle=(t, noisy), rate=(t, f * y["rate"])) for f in (1, factor))
    check_rates(model, [right])
    with pytest.raises(ValueError, match=r"r: rate is (5[67]|0\.0009).* times the rate of angle: check their units"):
        fit_records(model, [wrong], dt=0.05)


def spinning():
    """A pendulum that turns over and over."""
    return record(pendulum(), (0.5, 12.0), seed=4, samples=300)


@pytest.mark.parametrize(
    ("name", "times", "of", "dt", "said"),
    [
        ("angle", 1, lambda y: (y + np.pi) % (2 * np.pi) - np.pi, 0.02, "angle jumps by 2π: .* pass angles="),
        ("angle", 1, lambda y: np.rad2deg(y) % 360, 0.02, "angle jumps by 360: an angle is in rad"),
        ("angle", 1, lambda y: 1e3 * y, 0.02, "angle varies less than the fit's errors"),
        ("angle", 1e2, np.array, 0.02, r"most of angle is not between 0 and 8\.?\d* s: check all times"),
        ("torque", 1e3, np.array, 0.02, "most of torque is not between 0"),
        ("angle", 1, np.array, 5e-5, r"samples are 0\.0\d* s apart, \d* times dt: check both"),
    ],
)
def test_other_units_and_wrapped_angles_are_said(name, times, of, dt, said):
    signals = dict(spinning().signals)
    signals[name] = Signal(times * signals[name].t, of(signals[name].values))
    with pytest.warns(UserWarning, match=said) as warned:
        fit_records(model_of(pendulum()), [Record("r", signals)], dt=dt, max_steps=1, rounds=1)
    assert {w.filename for w in warned} == {__file__}


def test_an_angle_that_jumps_is_fitted_as_one_that_does_not():
    """Also across a gap in which it makes a turn, so that it cannot be unwrapped."""
    one = record(pendulum(), (0.5, 12.0), seed=4, samples=300, drop=(1.0, 2.0))
    y, free = one.signals["angle"], model_of(pendulum(0.82, 0.28))
    free = dataclasses.replace(free, start=(0.5, 12.0), spread=(0.1, 0.5))
    wrapped = Record("r", {**one.signals, "angle": Signal(y.t, (y.values + np.pi) % (2 * np.pi) - np.pi)})
    turning = dataclasses.replace(free, angles=("angle",))
    given = (free, one), (turning, wrapped)
    fit, same = (fit_records(model, [each], dt=0.02) for model, each in given)
    assert fit.errors["angle"] < 2 * NOISE
    for name, (value, *_) in fit.intervals.items():
        assert float(same.intervals[name].value) == pytest.approx(float(value), abs=1e-6)
    poor = dataclasses.replace(turning, field=pendulum(1.2, 0.1), spread=(np.inf, np.inf))
    found = fit_records(poor, [wrapped], dt=0.02, segment=0.5)
    assert float(found.intervals["log_length"].value) == pytest.approx(
        float(fit.intervals["log_length"].value), abs=1e-3
    )
    still = dataclasses.replace(turning, start=(0.5, 0.0), spread=(0.0, 0.0))  # the wrong start, which is kept
    with pytest.warns(UserWarning, match="^records: angle is off by more than a radian: check"):
        fit_records(still, [wrapped], dt=0.02, max_steps=1, rounds=1)
    with pytest.raises(ValueError, match="angles must be names of outputs, angle, got yaw"):
        dataclasses.replace(free, angles=("yaw",))


def test_a_past_far_from_the_models_start_is_found_and_a_short_one_said():
    one, model = spinning(), model_of(pendulum())
    past, future = one.part(2.0, 6.0), one.part(5.9, 8.0)
    y, seen = predict(model, past, future, dt=0.02)["angle"], future.signals["angle"]
    assert np.abs(y - seen.values[-len(y) :]).max() < 10 * NOISE
    two = Signal(seen.t[:2], seen.values[:2])
    with pytest.warns(UserWarning, match=r"too short to determine x\[0\], x\[1\]: the prediction is a guess") as warned:
        predict(model, Record("two", {**one.signals, "angle": two}), one.part(6.2, 8.0), dt=0.02)
    assert {w.filename for w in warned} == {__file__}  # also of the fit within
