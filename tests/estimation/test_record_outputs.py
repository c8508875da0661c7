"""The outputs of a model of records: sensors with numbers of their own, the states themselves, and their noise."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_record_fit import NOISE, angle, model_of, pendulum, record

import hybrid_jax as hj
from hybrid_jax import StateSpaceModel, fit_records, predict, simulate
from hybrid_jax.records import Record


@pytest.fixture(scope="module")
def records():
    second = record(pendulum(), (-0.4, 1.0), 6.0, 60, seed=2, drop=(2.0, 3.5), interval=0.25)
    return [record(pendulum(), (0.5, 0.0), seed=1), second]


class Biased(eqx.Module):
    bias: jax.Array

    def __call__(self, x, u):
        return x[0] + self.bias


def test_a_sensor_has_an_interval_and_the_names_of_intervals_are_those_of_priors(records):
    outputs = {"angle": Biased(jnp.array(0.1))}
    start = dataclasses.replace(model_of(pendulum(1.0, 0.1)), outputs=outputs)
    fit = fit_records(start, records, dt=0.02)
    bias = fit.intervals["angle.bias"]
    assert (set(fit.intervals), float(bias.value)) == (
        {"log_length", "damping", "angle.bias"},
        fit.model.outputs["angle"].bias,
    )
    assert float(bias.low) < 0 < float(bias.high) < 0.02
    kept = fit_records(start, records, dt=0.02, prior=dict.fromkeys(fit.intervals, 0.0), max_steps=9)
    assert eqx.tree_equal(
        jax.tree.map(float, (kept.model.field, kept.model.outputs)), jax.tree.map(float, (start.field, start.outputs))
    )


def test_records_may_have_different_sensors(records):
    """The first has an accelerometer, whose output needs the field's numbers, and the second the angle."""
    outputs = {"angle": angle, "acceleration": lambda x, u, field: field(x, u)[1]}
    model = dataclasses.replace(model_of(pendulum(1.0, 0.1)), outputs=outputs)
    true, torque = dataclasses.replace(model, field=pendulum()), records[0].signals["torque"]
    t = np.arange(0.0, 7.9, 0.11)
    y = simulate(
        true, Record.of("r", torque=(torque.t, torque.values), acceleration=(t, t)), np.array([0.5, 0]), dt=0.02
    )[0]
    noisy = y["acceleration"] + NOISE * np.random.default_rng(0).normal(size=(len(t), 1))
    felt = Record.of("felt", torque=(torque.t, torque.values), acceleration=(t, noisy))
    fit = fit_records(model, [felt, records[1]], dt=0.02)
    assert y.keys() == {"acceleration"} != fit.errors.keys()
    assert np.abs(fit.starts - [[0.5, 0.0], [-0.4, 1.0]]).max() < 0.05
    assert float(fit.intervals["log_length"].value) == pytest.approx(np.log(0.8), abs=0.01)
    with pytest.raises(ValueError, match="records: no record has a sample of angle"):
        fit_records(model, [felt], dt=0.02)


class Turntable(hj.AbstractVectorField):
    """x = [angle, rate, offset]: only the sum of angle and offset is seen."""

    damping: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - self.damping * x[1], 0 * x[2]])


def test_a_state_on_which_no_output_depends_is_named_with_its_direction(records):
    seen = {"angle": lambda x, u: x[0] + 2 * x[2]}
    model = StateSpaceModel(Turntable(jnp.array(1.0)), ("torque",), seen, np.zeros(3), np.full(3, 10.0))
    with pytest.warns(UserWarning, match=r"no sample determines 0.89 x\[0\] - 0.45 x\[2\] at the start of run 1$"):
        fit = fit_records(model, records[:1], dt=0.02)
    assert fit.undetermined == ()


@pytest.mark.filterwarnings("ignore:one. too short to determine")
def test_by_default_the_states_are_outputs_and_the_model_carries_their_noise(records):
    """The rate is not measured; a known noise stays, and weighs what a past tells beside what is expected."""
    signals = records[0].signals
    one = Record("one", {"torque": signals["torque"], "x[0]": signals["angle"]})
    bare = StateSpaceModel(pendulum(1.0, 0.1), ("torque",), start=(0.0, 0.0), spread=(np.inf, np.inf))
    fit, same = (
        fit_records(model, [each], dt=0.02) for model, each in ((bare, one), (model_of(bare.field), records[0]))
    )
    assert (list(fit.model.outputs), list(fit.errors)) == (["x[0]", "x[1]"], ["x[0]"])
    np.testing.assert_allclose(*(jax.tree.leaves(each.intervals) for each in (fit, same)), rtol=1e-6)
    np.testing.assert_allclose(fit.model.noise["x[0]"], fit.errors["x[0]"])
    assert fit.model.noise["x[0]"][0] == pytest.approx(NOISE, rel=0.2)
    with pytest.raises(ValueError, match=r"^noise must be names of outputs, x\[0\], x\[1\], got angle$"):
        dataclasses.replace(bare, noise={"angle": 1.0})
    past, future = one.part(0, 1.0), one.part(1.0, 2.0)
    expected = dataclasses.replace(fit.model, start=(0.0, 0.0), spread=(0.1, 0.1))
    coarse = dataclasses.replace(expected, noise={"x[0]": 10.0})
    sharp, vague = (predict(each, past, future, dt=0.02)["x[0]"] for each in (expected, coarse))
    still = simulate(expected, one.part(0, 2.0), dt=0.02)[0]["x[0]"][-len(vague) :]
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
        return StateSpaceModel(body, ("speeds",), start=start, spread=spread)

    known = model(0.1, level, tilt, np.zeros(3))
    zeros = t, np.zeros((len(t), 3))
    wanted = Record.of("r", speeds=(t, u), position=zeros, attitude=(t, u), **{"body rates": zeros})
    y = simulate(known, wanted, dt=0.02)[0]
    made = {name: (t, each + 1e-3 * random.normal(size=each.shape)) for name, each in y.items()}
    start = model(0.0, level, np.zeros(12), (1.0, 1.0, 0.0))
    turned = t, made.pop("attitude")[1] * (-1.0) ** np.arange(len(t))[:, None]
    seen = Record.of("r", speeds=(t, u), **made), Record.of("s", speeds=(t, u), attitude=turned)
    fit = fit_records(start, seen, dt=0.02)
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
