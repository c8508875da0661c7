"""Laws of windows in which some states were not measured: NaN in x counts as no error, in every fit."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import LENGTH, pendulum, swings, whirling

import hybrid_jax as hj
from hybrid_jax.estimation import covariance_of, fit_least_squares
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.training.objective import TrajectoryLoss

NOISE = np.array([0.02, 0.05])
WHOLE = swings(40, damping=0.0)
WHOLE = replace(WHOLE, x=np.asarray(WHOLE.x) + (NOISE * np.random.default_rng(0).normal(size=(40, 8, 2))).astype("f4"))


def masked(windows, share, seed=1):
    lost = np.random.default_rng(seed).random(windows.x.shape) < share
    return replace(windows, x=np.where(lost, np.nan, windows.x))


RATE_UNSEEN = replace(WHOLE, x=np.where([False, True], np.nan, WHOLE.x))
CASES = {"half": masked(WHOLE, 0.5), "most": masked(WHOLE, 0.85), "no rate": RATE_UNSEEN}
FITS = {
    "least squares": lambda field, windows: fit_least_squares(field, windows).field,
    "gauss newton": lambda field, windows: hj.fit_gauss_newton(field, windows).field,
    "auto": lambda field, windows: hj.adapt(field, windows).field,
    "fine tune": lambda field, windows: hj.adapt(field, windows, method=hj.adaptation.FineTune(rates=1e-2)).field,
    "fit": lambda field, windows: hj.fit(field, windows, windows, jax.random.key(0), max_epochs=150).best,
}


@pytest.mark.parametrize("case", ["most", "no rate"])
@pytest.mark.parametrize("fit", FITS)
def test_the_length_is_found_from_what_was_measured(fit, case):
    found = FITS[fit](pendulum(0.7), CASES[case])
    assert float(jnp.exp(found.log_length)) == pytest.approx(LENGTH, rel=0.02)


def test_intervals_hold_and_widen_as_measurements_are_lost():
    widths = []
    for share in (0.0, 0.5, 0.85):
        result = hj.adapt(pendulum(0.7), masked(WHOLE, share), level=0.99)
        found = result.parameters["log_length"]
        assert found.low < np.log(LENGTH) < found.high
        assert result.not_measured == pytest.approx(share, abs=0.05)
        assert ("Not measured" in result.report()) == (share > 0)
        widths.append(found.high - found.low)
        assert all(np.isfinite(each).all() for of in result.expected.values() for each in of.values())
    assert widths[0] < widths[1] < widths[2]
    # White noise: with half of the numbers at random the variance doubles.
    field = fit_least_squares(pendulum(0.7), WHOLE).field
    whole, half = (float(covariance_of(field, w)[0, 0]) for w in (WHOLE, CASES["half"]))
    assert half / whole == pytest.approx(2, rel=0.3)


def test_where_all_is_measured_the_loss_and_its_gradient_are_as_without_a_mask():
    loss, settings = TrajectoryLoss(), hj.Settings()

    def value(field, windows):
        batch = loss.batch(jax.tree.map(jnp.asarray, windows), settings)
        return loss.loss(field, batch, settings, jnp.zeros(()))[0]

    field = pendulum(0.7)
    predicted = hj.rollout_batch(field, WHOLE.x0, WHOLE.u, WHOLE.dt)
    plain = np.mean(np.sum(np.square(np.asarray(predicted) - WHOLE.x), axis=-1))
    np.testing.assert_allclose(value(field, WHOLE), plain, rtol=1e-6)
    np.testing.assert_allclose(rollout_mse(field, WHOLE), plain, rtol=1e-6)
    found, gradient = eqx.filter_value_and_grad(value)(field, CASES["half"])
    known = ~np.isnan(CASES["half"].x)
    np.testing.assert_allclose(found, np.sum(np.square(np.asarray(predicted) - WHOLE.x)[known]) / 320, rtol=1e-5)
    assert np.isfinite(gradient.log_length)
    assert gradient.log_length != 0


@pytest.mark.parametrize("turn", [0, 3, 7])
def test_an_angle_that_turns_while_it_is_not_measured_stays_continuous(turn):
    windows = swings(30, damping=0.0)
    x = np.array(windows.x)
    x[:, turn, 0] = np.nan
    x[..., 0] = np.mod(x[..., 0] + np.pi, 2 * np.pi) - np.pi
    found = FITS["least squares"](whirling(0.7), replace(windows, x=x))
    assert float(jnp.exp(found.log_length)) == pytest.approx(LENGTH, rel=1e-3)


def test_a_network_is_scaled_trained_saved_and_adapted(tmp_path):
    windows = CASES["half"]
    network = hj.residual_network(2, 1, jax.random.key(0), hidden=4, norm="none")
    source = hj.fit(hj.Hybrid(pendulum(0.7), network), windows, windows, jax.random.key(0), max_epochs=50).best
    hj.save(tmp_path / "source.npz", source)
    source = hj.load(tmp_path / "source.npz").field
    result = hj.adapt(source, masked(swings(40, damping=0.0, length=0.65, seed=3), 0.5))
    assert result.mse_after < 0.5 * result.mse_before
    assert result.outside


NOWHERE = replace(WHOLE, x=np.full_like(WHOLE.x, np.nan))
STARTS = replace(WHOLE, x0=np.where(np.arange(40)[:, None] == 3, np.nan, WHOLE.x0))


@pytest.mark.parametrize(
    ("windows", "method", "said"),
    [
        (STARTS, "auto", r"x0\[3, 0\] is not finite in float32; begin where every state is measured, or see `fit_rec"),
        (NOWHERE, "auto", "x is NaN everywhere: no state was measured"),
        (CASES["half"], "linear_residual", r"windows: x\[0, 1, 0\] is not finite in float32; leave such windows out"),
    ],
)
def test_what_is_still_needed_is_said(windows, method, said):
    with pytest.raises(ValueError, match=said):
        partial(hj.adapt, method=method)(pendulum(0.7), windows)
