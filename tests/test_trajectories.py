"""Laws of windows cut from flights, and of metrics on them; NaN in x, a state not measured, is no error in any fit."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import LENGTH, pendulum, swings, whirling
from surface import refusal, with_number

import hybrid_jax as hj
from hybrid_jax import metrics, rollout_batch
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.training.objective import TrajectoryLoss
from hybrid_jax.trajectories import Trajectories, check, concatenate, windows_of

STEPS = 5


def flight(intervals=23, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(intervals + 1, 3)), rng.normal(size=(intervals, 2))


def windows():
    return windows_of(*flight(), 0.01, steps=STEPS)


def test_windows_partition_a_flight_and_overlap_with_a_stride():
    states, inputs = flight()
    cut = windows_of(states, inputs, 0.01, steps=STEPS)
    assert (len(cut), cut.horizon, cut.dt) == (4, STEPS, 0.01)
    np.testing.assert_array_equal(np.concatenate(cut.u), inputs[:20])
    np.testing.assert_array_equal(np.concatenate(cut.x), states[1:21])
    np.testing.assert_array_equal(cut.x0, states[[0, 5, 10, 15]])
    assert check(cut) is cut
    states, inputs = flight()
    cut = windows_of(states, inputs, 0.01, steps=STEPS, stride=2)
    assert len(cut) == 10  # starts 0, 2, …, 18; the window from 18 ends with the flight
    np.testing.assert_array_equal(cut.x[-1, -1], states[-1])
    np.testing.assert_array_equal(cut.u[3], inputs[6:11])


@pytest.mark.parametrize(("intervals", "steps", "stride"), [(4, 5, None), (23, 0, None), (23, 5, 0), (23, 5, -1)])
def test_a_flight_without_a_window_is_refused(intervals, steps, stride):
    with pytest.raises(ValueError, match=r"has no window of steps|st(eps|ride) must be an integer of at least 1"):
        windows_of(*flight(intervals), 0.01, steps=steps, stride=stride)


def test_concatenate_keeps_order_and_refuses_what_does_not_fit_and_slices_and_traced_indices_pick_windows():
    a, b = windows(), windows_of(*flight(seed=1), 0.01, steps=STEPS)
    joined = concatenate([a, b])
    np.testing.assert_array_equal(joined.x[4:], b.x)
    for other in (replace(b, dt=0.02), windows_of(*flight(), 0.01, steps=4)):
        with pytest.raises(ValueError, match=r"^windows must share dt and horizon"):
            concatenate([a, other])
    refusal(lambda: concatenate([]), "^windows must contain at least one Trajectories, but the list is empty")
    np.testing.assert_array_equal(concatenate(iter([a, a])).x, concatenate([a, a]).x)
    for other in (a, [a, a.x], "ab"):
        with pytest.raises(ValueError, match=r"^windows must be a list of Trajectories, got "):
            concatenate(other)
    cut = windows()
    np.testing.assert_array_equal(cut[1:3].u, cut.u[1:3])
    picked = jax.jit(lambda index, windows: windows[index])(jnp.array([3, 0]), jax.tree.map(jnp.asarray, cut))
    np.testing.assert_array_equal(picked.x, cut.x.astype(np.float32)[[3, 0]])
    assert picked.dt == cut.dt


NOTHING = Trajectories(np.zeros((2, 3)), np.zeros((2, 0, 1)), np.zeros((2, 0, 3)), 0.1)
BAD = [(windows()[0], "must have 2, 3, 3 axes"), (windows()[:0], "is empty"), (NOTHING, "is empty")]
BAD += [(replace(windows(), dt=dt), "dt must be a positive number") for dt in (0.0, -0.01, np.nan, np.inf)]
SHORT = [replace(windows(), **{part: getattr(windows(), part)[..., :-1, :]}) for part in ("x0", "u", "x")]
BAD += [(cut, "trajectories: shapes of x0 .* do not agree") for cut in SHORT]
SPOILED = [replace(windows(), u=with_number(value, windows().u, 16)) for value in (np.nan, np.inf, -np.inf)]
BAD += [(cut, r"trajectories: u\[1, 3, 0\] is not finite") for cut in SPOILED]


@pytest.mark.parametrize(("cut", "said"), BAD)
def test_what_is_wrong_with_windows_is_named(cut, said):
    with pytest.raises(ValueError, match=said):
        check(cut)


@pytest.mark.parametrize(("every", "chunk"), [(1, 250), (2, 7), (4, 250), (8, 20)])
def test_an_error_is_the_definition_at_every_so_many_intervals(every, chunk, monkeypatch):
    monkeypatch.setattr(metrics, "CHUNK", chunk)
    windows, field = swings(20), pendulum(0.6)
    predicted = np.asarray(rollout_batch(field, windows.x0, windows.u, windows.dt), np.float64)
    squares = np.square(predicted - np.asarray(windows.x)).sum(-1)
    rows = [i for i in range(8) if (i + 1) % every == 0]
    found = metrics.rollout_mse(field, windows, every)
    np.testing.assert_allclose(found, squares[:, rows].mean(), rtol=1e-5)  # float32 sums of 160 numbers


def test_mse_by_hand_and_an_error_beyond_float_is_not_finite():
    truth = jnp.zeros((2, 2, 3))
    predicted = jnp.array([[1.0, 2.0, 2.0], [0.0, 3.0, 4.0]])
    both = metrics.mse(jnp.stack([predicted, 2 * predicted]), truth)
    np.testing.assert_array_equal(both, [17, 68])  # squared norms, mean over time: not over the elements
    lost = pendulum(damping=-1e6)
    assert not jnp.isfinite(metrics.rollout_mse(lost, swings(20)))


NOISE = np.array([0.02, 0.05])
WHOLE = swings(40, damping=0.0)
WHOLE = replace(WHOLE, x=np.asarray(WHOLE.x) + (NOISE * np.random.default_rng(0).normal(size=(40, 8, 2))).astype("f4"))


def masked(whole, share, seed=1):
    lost = np.random.default_rng(seed).random(whole.x.shape) < share
    return replace(whole, x=np.where(lost, np.nan, whole.x))


RATE_UNSEEN = replace(WHOLE, x=np.where([False, True], np.nan, WHOLE.x))
CASES = {"half": masked(WHOLE, 0.5), "most": masked(WHOLE, 0.85), "no rate": RATE_UNSEEN}
FITS = {
    "least squares": lambda field, windows: hj.fit_least_squares(field, windows).field,
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
    field = hj.fit_least_squares(pendulum(0.7), WHOLE).field
    whole, half = (float(hj.covariance_of(field, w)[0, 0]) for w in (WHOLE, CASES["half"]))
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


def test_a_network_is_scaled_trained_saved_and_adapted_and_what_is_still_needed_is_said(tmp_path):
    windows = CASES["half"]
    network = hj.residual_network(2, 1, jax.random.key(0), hidden=4, norm="none")
    source = hj.fit(hj.Hybrid(pendulum(0.7), network), windows, windows, jax.random.key(0), max_epochs=50).best
    hj.save(tmp_path / "source.npz", source)
    source = hj.load(tmp_path / "source.npz").field
    result = hj.adapt(source, masked(swings(40, damping=0.0, length=0.65, seed=3), 0.5))
    assert result.mse_after < 0.5 * result.mse_before
    assert result.outside
    for windows, method, said in (
        (STARTS, "auto", "x0[3, 0] is not finite in float32; begin where every state is measured, or see `fit_rec"),
        (NOWHERE, "auto", "x is NaN everywhere: no state was measured"),
        (ANGLES, "linear_residual", "windows: no interval has all states measured at both ends"),
    ):
        refusal(partial(hj.adapt, pendulum(0.7), windows, method=method), said)


ANGLES = replace(WHOLE, x=np.where([True, False], WHOLE.x, np.nan))
NOWHERE = replace(WHOLE, x=np.full_like(WHOLE.x, np.nan))
STARTS = replace(WHOLE, x0=np.where(np.arange(40)[:, None] == 3, np.nan, WHOLE.x0))
