"""Outputs of a model of records: numbers and noise of their own; what cannot be right, or no sample tells, is named."""

import dataclasses
import logging
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import Biased
from surface import refusal
from test_record_fit import NOISE, angle, model_of, pendulum, record, records

import hybrid_jax as hj
from hybrid_jax import StateSpaceModel, fit_records, predict, simulate
from hybrid_jax.estimation.record_search import check_rates
from hybrid_jax.records import Record, Signal


def test_a_sensor_has_an_interval_and_the_names_of_intervals_are_those_of_priors():
    outputs = {"angle": Biased(jnp.array(0.1))}
    start = dataclasses.replace(model_of(pendulum(1.0, 0.1)), outputs=outputs)
    fit = hj.fit_records(start, records(), dt=0.02)
    bias = fit.intervals["angle.bias"]
    assert fit.intervals.keys() == {"log_length", "damping", "angle.bias"}
    assert float(bias.value) == fit.model.outputs["angle"].bias
    assert float(bias.low) < 0 < float(bias.high) < 0.02
    kept = hj.fit_records(start, records(), dt=0.02, prior=dict.fromkeys(fit.intervals, 0.0), max_steps=9)
    assert eqx.tree_equal(*(jax.tree.map(float, (each.field, each.outputs)) for each in (kept.model, start)))


def test_records_may_have_different_sensors():
    """The first has an accelerometer, whose output needs the field's numbers, and the second the angle."""
    outputs = {"angle": angle, "acceleration": lambda x, u, field: field(x, u)[1]}
    model = dataclasses.replace(model_of(pendulum(1.0, 0.1)), outputs=outputs)
    true, torque = dataclasses.replace(model, field=pendulum()), records()[0].signals["torque"]
    t = np.arange(0.0, 7.9, 0.11)
    wanted = hj.Record.of("r", torque=(torque.t, torque.values), acceleration=(t, t))
    y = hj.simulate(true, wanted, np.array([0.5, 0]), dt=0.02)[0]
    noisy = y["acceleration"] + NOISE * np.random.default_rng(0).normal(size=(len(t), 1))
    felt = hj.Record.of("felt", torque=(torque.t, torque.values), acceleration=(t, noisy))
    fit = hj.fit_records(model, [felt, records()[1]], dt=0.02)
    assert y.keys() == {"acceleration"} != fit.errors.keys()
    assert np.abs(fit.starts - [[0.5, 0.0], [-0.4, 1.0]]).max() < 0.05
    assert float(fit.intervals["log_length"].value) == pytest.approx(np.log(0.8), abs=0.01)
    refusal(lambda: hj.fit_records(model, [felt], dt=0.02), "records: no record has a sample of angle")


class Turntable(hj.AbstractVectorField):
    """x = [angle, rate, offset]: only the sum of angle and offset is seen."""

    damping: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - self.damping * x[1], 0 * x[2]])


def test_a_state_on_which_no_output_depends_is_named_with_its_direction():
    seen = {"angle": lambda x, u: x[0] + 2 * x[2]}
    model = hj.StateSpaceModel(Turntable(jnp.array(1.0)), ("torque",), seen, np.zeros(3), np.full(3, 10.0))
    with pytest.warns(UserWarning, match=r"no sample determines 0.89 x\[0\] - 0.45 x\[2\] at the start of run 1$"):
        fit = hj.fit_records(model, records()[:1], dt=0.02)
    assert fit.undetermined == ()


@pytest.mark.filterwarnings("ignore:one. too short to determine")
def test_by_default_the_states_are_outputs_and_the_model_carries_their_noise():
    """The rate is not measured; a known noise stays, and weighs what a past tells beside what is expected."""
    signals = records()[0].signals
    one = hj.Record("one", {"torque": signals["torque"], "x[0]": signals["angle"]})
    bare = hj.StateSpaceModel(pendulum(1.0, 0.1), ("torque",), start=(0.0, 0.0), spread=(np.inf, np.inf))
    given = (bare, one), (model_of(bare.field), records()[0])
    fit, same = (hj.fit_records(model, [each], dt=0.02) for model, each in given)
    assert (list(fit.model.outputs), list(fit.errors)) == (["x[0]", "x[1]"], ["x[0]"])
    np.testing.assert_allclose(*(jax.tree.leaves(each.intervals) for each in (fit, same)), rtol=1e-6)
    np.testing.assert_allclose(fit.model.noise["x[0]"], fit.errors["x[0]"])
    assert fit.model.noise["x[0]"][0] == pytest.approx(NOISE, rel=0.2)
    with pytest.raises(ValueError, match=r"^noise must be names of outputs, x\[0\], x\[1\], got angle$"):
        dataclasses.replace(bare, noise={"angle": 1.0})
    past, future = one.part(0, 1.0), one.part(1.0, 2.0)
    expected = dataclasses.replace(fit.model, start=(0.0, 0.0), spread=(0.1, 0.1))
    coarse = dataclasses.replace(expected, noise={"x[0]": 10.0})
    sharp, vague = (hj.predict(each, past, future, dt=0.02)["x[0]"] for each in (expected, coarse))
    still = hj.simulate(expected, one.part(0, 2.0), dt=0.02)[0]["x[0]"][-len(vague) :]
    assert np.abs(vague - still).max() < 1e-3 < 0.1 < np.abs(sharp - still).max()


def test_the_start_of_a_body_is_corrected_in_the_tangent_space_of_its_attitude():
    """Gyro and position: the tilt of the start follows from where the thrust leads, and its quaternion keeps norm 1.

    The second record has the attitude, in which q and −q are the same.
    """
    level, hover = np.eye(13)[3], hj.IRIS.hover_speed
    tilt = np.r_[np.zeros(3), 0.3, -0.2, np.zeros(8)]
    t, random = np.arange(0.0, 1.0, 0.02), np.random.default_rng(0)
    u = hover * (1.05 + 0.02 * random.normal(size=(len(t), 4)))

    def model(k, start, tilted, attitude):
        body = eqx.tree_at(lambda body: body.deviations["k"], hj.rigid_body(hj.IRIS, ("k",)), jnp.array(k))
        start = np.asarray(body.state_space.retract(jnp.array(start), jnp.array(tilted[:12])))
        spread = np.r_[np.zeros(3), attitude, np.zeros(6)]
        return hj.StateSpaceModel(body, ("speeds",), start=start, spread=spread)

    known = model(0.1, level, tilt, np.zeros(3))
    zeros = t, np.zeros((len(t), 3))
    wanted = hj.Record.of("r", speeds=(t, u), position=zeros, attitude=(t, u), **{"body rates": zeros})
    y = hj.simulate(known, wanted, dt=0.02)[0]
    made = {name: (t, each + 1e-3 * random.normal(size=each.shape)) for name, each in y.items()}
    start = model(0.0, level, np.zeros(12), (1.0, 1.0, 0.0))
    turned = t, made.pop("attitude")[1] * (-1.0) ** np.arange(len(t))[:, None]
    seen = hj.Record.of("r", speeds=(t, u), **made), hj.Record.of("s", speeds=(t, u), attitude=turned)
    fit = hj.fit_records(start, seen, dt=0.02)
    np.testing.assert_allclose(np.linalg.norm(fit.starts[:, 3:7], axis=1), 1)
    np.testing.assert_allclose(fit.starts[:, 3:7], [known.start[3:7]] * 2, atol=5e-3)
    assert (fit.starts_error.shape, (fit.starts_error[:, 3:5] > 0).all()) == ((2, 12), True)
    assert np.sqrt(np.mean(np.square(fit.model.noise["attitude"]))) == pytest.approx(2e-3, rel=0.2)  # of q: half of it
    assert float(fit.model.field.deviations["k"]) == pytest.approx(0.1, abs=5e-3)


def test_outputs_keep_their_order_through_jax():
    outputs = {"rate": lambda x, u: x[1], "angle": angle}
    model = dataclasses.replace(model_of(pendulum()), outputs=outputs, noise={"rate": 0.1, "angle": 0.2})
    through = jax.tree.map(lambda leaf: leaf, model)
    assert [*through.outputs] == [*model.only(["rate", "angle"]).outputs] == ["rate", "angle"]
    assert [*through.noise] == ["rate", "angle"]


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


def spinning(**options):
    """A pendulum that turns over and over."""
    return record(pendulum(), (0.5, 12.0), seed=4, samples=300, **options)


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
    one = spinning(drop=(1.0, 2.0))
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
    one, other = (float(each.intervals["log_length"].value) for each in (found, fit))
    assert one == pytest.approx(other, abs=1e-3)
    still = dataclasses.replace(turning, start=(0.5, 0.0), spread=(0.0, 0.0))  # the wrong start, which is kept
    with pytest.warns(UserWarning, match="^records: angle is off by more than a radian: check"):
        fit_records(still, [wrapped], dt=0.02, max_steps=1, rounds=1)
    refusal(lambda: dataclasses.replace(free, angles=("yaw",)), "angles must be names of outputs, angle, got yaw")


def test_a_past_far_from_the_models_start_is_found_a_short_one_said_and_inputs_after_it_are_not_held():
    one, model = spinning(), model_of(pendulum())
    past, future = one.part(2.0, 6.0), one.part(5.9, 8.0)
    y, seen = predict(model, past, future, dt=0.02)["angle"], future.signals["angle"]
    assert np.abs(y - seen.values[-len(y) :]).max() < 10 * NOISE
    two = Signal(seen.t[:2], seen.values[:2])
    with pytest.warns(UserWarning, match=r"too short to determine x\[0\], x\[1\]: the prediction is a guess") as warned:
        predict(model, Record("two", {**one.signals, "angle": two}), one.part(6.2, 8.0), dt=0.02)
    assert {w.filename for w in warned} == {__file__}  # also of the fit within
    near = np.arange(0, 1, 0.1)
    times = {"past": near, "future": near + 9}
    past, future = (Record.of(name, torque=(t, t), angle=(t, t)) for name, t in times.items())
    with pytest.raises(ValueError, match=r"^future: torque begins at 9 s, and the past ends at 0\.9 s$"):
        predict(model_of(pendulum()), past, future, dt=0.02)


def test_pasts_with_other_numbers_of_samples_share_programs(caplog):
    one, model = spinning(), model_of(pendulum())
    past, future = one.part(2.0, 6.0), one.part(6.0, 8.0)
    predict(model, past, future, dt=0.02)
    seen = past.signals["angle"]
    fewer = Signal(np.delete(seen.t, slice(3, None, 9)), np.delete(seen.values, slice(3, None, 9), axis=0))
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        predict(model, Record("fewer", {**past.signals, "angle": fewer}), future, dt=0.02)
    assert not re.search(r"XLA compilation of jit\((shooting|simulation)\)", caplog.text)
