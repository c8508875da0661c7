"""Windows of records: they begin at estimated states, and a fit to their samples finds what made them."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import Biased
from surface import refusal
from test_record_fit import NOISE, angle, model_of, pendulum, records

import hybrid_jax as hj
from hybrid_jax.networks.standardise import motion_of
from hybrid_jax.records import Record
from hybrid_jax.training.driver import ready


def test_windows_begin_at_states_estimated_from_the_samples_around_them_and_a_fit_to_them_finds_what_made_them():
    known, near = model_of(pendulum(), noise={"angle": NOISE}), {"dt": 0.02, "steps": 20, "around": 0.5}
    windows = hj.estimate_windows(known, records()[:1], **near)
    places = 25 + 20 * np.arange(len(windows))[:, None] + np.arange(21)
    x0, *x = np.moveaxis(hj.simulate(known, records()[0], (0.5, 0.0), dt=0.02)[1][places], 1, 0)
    assert (np.std(windows.states.x0 - x0, axis=0) < (NOISE, 0.06)).all()
    true = eqx.tree_at(lambda w: w.states.x0, windows, jnp.asarray(x0, jnp.float32))
    assert float(true.loss(known, jnp.stack(x, axis=1))) == pytest.approx(1.0, abs=0.3)
    wrong = model_of(pendulum(0.9, 0.1), noise={"angle": NOISE})
    biased = dataclasses.replace(wrong, outputs={"angle": Biased(jnp.array(0.1))})
    trained = hj.fit(wrong, windows, windows, jax.random.key(0), max_epochs=400)
    descended = hj.fit_gauss_newton(biased, windows)
    for found in (trained.best, descended.field):
        assert np.exp(found.field.log_length) == pytest.approx(0.8, abs=0.01)
        assert found.field.damping == pytest.approx(0.3, abs=0.05)
    assert descended.loss == pytest.approx(float(trained.best_mse), rel=0.05)
    assert descended.field.outputs["angle"].bias == pytest.approx(0.0, abs=0.01)
    for model, around, said in ((known, 5, "all are shorter than 10 s"), (model_of(pendulum()), 1, "angle has none")):
        refusal(lambda m=model, a=around: hj.estimate_windows(m, records()[:1], **near | {"around": a}), said)
    refusal(lambda: hj.fit(known.field, windows, windows, jax.random.key(0)), "field must be a StateSpaceModel")
    refusal(lambda: hj.fit_gauss_newton(known.field, windows), "field must be a StateSpaceModel")
    refusal(lambda: hj.fit_gauss_newton(known, windows, scale=np.ones(2)), "scale must be None for windows of records")
    refusal(lambda: hj.fit_gauss_newton(known, windows[:0]), "windows must contain at least one window")
    wide = hj.Hybrid(pendulum(), hj.residual_network(2, 1, jax.random.key(0), hidden=1000))
    known = dataclasses.replace(known, field=wide)
    refusal(lambda: hj.fit_records(known, records(), dt=0.02), "wrap the network in Frozen")
    seen = motion_of(ready(known, windows).field)  # a trained network knows in which states it was trained
    np.testing.assert_array_equal(seen.x0, windows.states.x0)
    other = hj.StateSpaceModel(pendulum(), ("torque",), {"speed": lambda x, u: x[1]}, (0.0, 0.0), (1.0, 1.0))
    refusal(lambda: hj.fit(other, windows, windows, jax.random.key(0)), "has no output angle; it has speed")


@pytest.mark.parametrize("late", [0.0, 0.013])  # at the edges of intervals, which needs no interpolation, or between
def test_windows_compare_each_sample_at_its_own_time_with_its_own_input_and_an_outlier_counts_less(late):
    outputs = {"angle": angle, "force": lambda x, u: u[0] - x[1]}
    model = dataclasses.replace(model_of(pendulum()), outputs=outputs, noise=dict.fromkeys(outputs, NOISE))
    t = np.arange(0, 8, 0.02)
    torque, times = (t, np.random.default_rng(0).normal(size=len(t))), np.append(0.0, t[2::2] + late)
    blank = Record.of("even", torque=torque, **dict.fromkeys(outputs, (times, 0 * times)))
    y = hj.simulate(model, blank, (0.5, 0.0), dt=0.02, begin=0.0)[0]
    y["angle"][80] += 100 * NOISE

    def windows(**options):
        record = Record.of("even", torque=torque, **{name: (times[: len(each)], each) for name, each in y.items()})
        return hj.estimate_windows(model, [record], dt=0.02, steps=21, around=0.5, **options)

    plain, robust = (each.loss(model, each.states.x) for each in (windows(), windows(robust=3.0)))
    assert 5 * robust < plain
    y["angle"][80] -= 100 * NOISE
    assert (windows().segments.share is None) == (late == 0)
    assert windows().loss(model, windows().states.x) < 1e-4
